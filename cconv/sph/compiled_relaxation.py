"""Shifts of the SPH relaxation by the solver's compiled loops, for the CPU; equations in `cconv.sph.relaxation`."""

from functools import lru_cache

import numpy as np
from torch import Tensor

from cconv.domain import Box
from cconv.sph import pair_loops
from cconv.sph.kernel_table import kernel_tables
from cconv.sph.kernels import QuinticSpline
from cconv.sph.neighbor_list import NeighborList, moved, padded, periodic_lengths, unpadded
from cconv.sph.solver import EquationOfState

LEAST_DENSITY, MOST_DENSITY = 0.98, 1.02  # of that at rest; from the text of the paper
SKIN = 0.3  # of the neighbour list, in particle spacings
FLUID = EquationOfState(rest_density=1.0, sound_speed=10.0)


class CompiledParticles:
    """Particles that are shifted by pressure and viscosity.

    Args:
        positions: x (N, D), length.
        before: Positions a frame earlier (N, D).
        is_wall: Which particles are walls (N,).
        box: Domain with its periodic axes, each at least 6.6 particle spacings long.
        particle_spacing: dx, length.
    """

    def __init__(self, positions: Tensor, before: Tensor, is_wall: Tensor, box: Box, particle_spacing: float):
        shifted = positions.double()
        self._places, self._displacements = padded(shifted), padded(box.displacement(shifted, before.double()))
        self._support, self._values, self._slopes = _kernel(particle_spacing, box.dim)
        self._neighbors = NeighborList(box, self._support, SKIN * particle_spacing)
        self._lengths, self._is_wall = periodic_lengths(box), is_wall.numpy()
        self._box, self._particle_spacing = box, particle_spacing
        self._masses = np.full(len(positions), particle_spacing**box.dim)

    @property
    def positions(self) -> Tensor:
        """Where the particles are now, (N, D), float64."""
        return unpadded(self._places, self._box.dim)

    def move(self, shifts: np.ndarray) -> None:
        """Shift the particles by (N, 3)."""
        self._places = moved(self._places, shifts, 1.0, self._box)
        self._displacements = self._displacements + shifts

    def shifts(self, beta: float) -> np.ndarray:
        """Shifts (N, 3) for an alpha of 1, length; zero for walls."""
        positions, displacements = self._places, self._displacements
        rows = self._neighbors.rows(positions, self._is_wall)
        densities = self._densities(positions)
        pressures, velocities = FLUID.pressure(densities), displacements.copy()
        none = np.zeros_like(positions)
        rows.visit(
            pair_loops.extrapolate_to_walls, positions, self._lengths, self._support, self._values, self._is_wall,
            none, densities, pressures, displacements, displacements, velocities, velocities,
        )  # fmt: skip
        densities = np.where(self._is_wall, FLUID.density(pressures), densities)
        accelerations = np.zeros_like(positions)
        viscosities = np.full(len(positions), float(beta))
        rows.visit(
            pair_loops.accelerations, positions, self._lengths, self._masses, self._support, self._slopes,
            self._is_wall, velocities, velocities, densities, pressures, viscosities, True, 0.0, 0.0, 0.0,
            accelerations, none,
        )  # fmt: skip
        return self._particle_spacing**2 * accelerations

    def _densities(self, positions: np.ndarray) -> np.ndarray:
        """Densities (N,) of the fluid relative to that at rest, within the limits; 1 for walls."""
        summed = np.ones(len(positions))
        self._neighbors.rows(positions, self._is_wall).visit(
            pair_loops.sum_densities, positions, self._lengths, self._masses, self._support, self._values,
            self._is_wall, summed,
        )  # fmt: skip
        return np.where(summed < LEAST_DENSITY, 1.0, np.minimum(summed, MOST_DENSITY))


@lru_cache(maxsize=8)
def _kernel(particle_spacing: float, dim: int) -> tuple[float, np.ndarray, np.ndarray]:
    """Support radius and tables of W and dW/dr, which a rollout needs again in every frame."""
    kernel = QuinticSpline(particle_spacing, dim)
    return kernel.support_radius, *kernel_tables(kernel)
