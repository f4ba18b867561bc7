"""Shifts of the SPH relaxation in torch operations, for devices other than the CPU.

The equations are in `cconv.sph.relaxation`. Sums over pairs are those of Adami, Hu, Adams, "A generalized wall boundary
condition for smoothed particle hydrodynamics" (2012), eqs. 22, 23 and 27, and "A transport-velocity formulation for
smoothed particle hydrodynamics" (2013), eq. 8, with kernels computed exactly, where compiled loops look them up.
"""

import torch
from torch import Tensor

from cconv.devices import finest_dtype
from cconv.domain import Box
from cconv.neighbors import Edges, radius_graph
from cconv.sph.compiled_relaxation import FLUID, LEAST_DENSITY, MOST_DENSITY, SKIN
from cconv.sph.kernels import QuinticSpline
from cconv.sph.neighbor_list import check_wide_enough
from cconv.sph.operators import density, sum_over_neighbors


class TensorParticles:
    """Particles that are shifted by pressure and viscosity; arguments as of `CompiledParticles`, on any device."""

    def __init__(self, positions: Tensor, before: Tensor, is_wall: Tensor, box: Box, particle_spacing: float):
        self.positions = positions.to(finest_dtype(positions.device))
        self._displacements = box.displacement(self.positions, before.to(self.positions))
        self._is_wall, self._box, self._particle_spacing = is_wall, box, particle_spacing
        self._kernel = QuinticSpline(particle_spacing, box.dim)
        check_wide_enough(box, self._kernel.support_radius + SKIN * particle_spacing)  # as the CPU's neighbour list

    def move(self, shifts: Tensor) -> None:
        """Shift the particles by (N, D)."""
        self.positions = self._box.wrap(self.positions + shifts)
        self._displacements = self._displacements + shifts

    def shifts(self, beta: float) -> Tensor:
        """Shifts (N, D) for an alpha of 1, length; zero for walls."""
        edges = radius_graph(self.positions, self._kernel.support_radius, self._box)
        stiffness, own = FLUID.reference_pressure, self._densities(edges)
        pressures, velocities = self._at_walls(stiffness * (own - 1), edges)
        densities = torch.where(self._is_wall, pressures / stiffness + 1, own)
        i, j = edges.receivers, edges.senders
        apart = edges.distances > 0
        slopes = self._kernel.derivative(edges.distances) / torch.where(apart, edges.distances, 1.0)
        volume = self._particle_spacing**self._box.dim
        prefactors = volume * (densities[i] ** -2 + densities[j] ** -2) * slopes * apart
        mean_pressures = (densities[j] * pressures[i] + densities[i] * pressures[j]) / (densities[i] + densities[j])
        terms = beta * (self._displacements[i] - velocities[j]) - mean_pressures[:, None] * edges.displacements
        accelerations = sum_over_neighbors(prefactors[:, None] * terms, edges)
        return torch.where(self._is_wall[:, None], 0.0, self._particle_spacing**2 * accelerations)

    def _densities(self, edges: Edges) -> Tensor:
        """Densities (N,) of the fluid relative to that at rest, within the limits; 1 for walls."""
        masses = torch.full_like(self.positions[:, 0], self._particle_spacing**self._box.dim)
        summed = density(masses, edges, self._kernel)
        return torch.where((summed < LEAST_DENSITY) | self._is_wall, 1.0, summed.clamp(max=MOST_DENSITY))

    def _at_walls(self, pressures: Tensor, edges: Edges) -> tuple[Tensor, Tensor]:
        """Pressures and velocities with those of walls from the fluid near them; 0 and its own for one without any."""
        is_wall, displacements = self._is_wall, self._displacements
        weights = torch.where(is_wall[edges.senders], 0.0, self._kernel.value(edges.distances))
        total = sum_over_neighbors(weights, edges)
        near = is_wall & (total > 0)
        divisor = torch.where(near, total, 1.0)
        pressure = sum_over_neighbors(weights * pressures[edges.senders], edges) / divisor
        velocity = sum_over_neighbors(weights[:, None] * displacements[edges.senders], edges) / divisor[:, None]
        return (
            torch.where(is_wall, torch.where(near, pressure, 0.0), pressures),
            torch.where(near[:, None], 2 * displacements - velocity, displacements),
        )
