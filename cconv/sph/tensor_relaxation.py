"""Shifts of the SPH relaxation in torch operations, for devices other than the CPU.

The equations are in `cconv.sph.relaxation`. Sums over pairs are those of Adami, Hu, Adams, "A generalized wall boundary
condition for smoothed particle hydrodynamics" (2012), eqs. 22, 23 and 27, and "A transport-velocity formulation for
smoothed particle hydrodynamics" (2013), eq. 8, with kernels computed exactly, where compiled loops look them up.
"""

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from cconv.domain import Box
from cconv.neighbors import Edges, radius_graph
from cconv.sph.kernels import QuinticSpline


def shifts(
    positions: Float[Tensor, "N D"],
    displacements: Float[Tensor, "N D"],
    is_wall: Bool[Tensor, " N"],
    *,
    box: Box,
    particle_spacing: float,
    beta: float,
    densities_within: tuple[float, float],
    stiffness: float,
) -> Float[Tensor, "N D"]:
    """Shifts of the fluid by pressure and viscosity for an alpha of 1, length; zero for walls.

    Args:
        positions: x (N, D), length.
        displacements: u (N, D), length per frame.
        is_wall: Which particles are walls (N,).
        box: Domain with its periodic axes, each at least six particle spacings long.
        particle_spacing: dx, length.
        beta: Viscosity relative to the pressure.
        densities_within: Below the first, of that at rest, a density counts as at rest, above the second as the second.
        stiffness: p of a density ρ is this times ρ - 1.

    Raises:
        ConfigError: If the box is too narrow.
    """
    kernel = QuinticSpline(particle_spacing, box.dim)
    edges = radius_graph(positions, kernel.support_radius, box)
    volume = particle_spacing**box.dim
    weights = kernel.value(edges.distances)
    least, most = densities_within
    summed = volume * (kernel.value(weights.new_zeros(())) + _summed(weights, edges))
    fluid = torch.where((summed < least) | is_wall, 1.0, summed.clamp(max=most))
    pressures, velocities = _at_walls(stiffness * (fluid - 1), displacements, is_wall, weights, edges)
    densities = torch.where(is_wall, (pressures / stiffness + 1).clamp(min=0), fluid)
    i, j = edges.receivers, edges.senders
    apart = edges.distances > 0
    slopes = kernel.derivative(edges.distances) / torch.where(apart, edges.distances, 1.0)
    prefactors = volume * (densities[i] ** -2 + densities[j] ** -2) * slopes * apart
    mean_pressures = (densities[j] * pressures[i] + densities[i] * pressures[j]) / (densities[i] + densities[j])
    terms = -mean_pressures[:, None] * edges.displacements + beta * (displacements[i] - velocities[j])
    accelerations = _summed(prefactors[:, None] * terms, edges)
    return torch.where(is_wall[:, None], 0.0, particle_spacing**2 * accelerations)


def _at_walls(
    pressures: Tensor, displacements: Tensor, is_wall: Tensor, weights: Tensor, edges: Edges
) -> tuple[Tensor, Tensor]:
    """Pressures and velocities with those of walls from the fluid near them; 0 and its own for one without any."""
    of_fluid = torch.where(is_wall[edges.senders], 0.0, weights)
    total = _summed(of_fluid, edges)
    near = is_wall & (total > 0)
    divisor = torch.where(near, total, 1.0)
    pressure = _summed(of_fluid * pressures[edges.senders], edges) / divisor
    velocity = _summed(of_fluid[:, None] * displacements[edges.senders], edges) / divisor[:, None]
    return (
        torch.where(is_wall, torch.where(near, pressure, 0.0), pressures),
        torch.where(near[:, None], 2 * displacements - velocity, displacements),
    )


def _summed(terms: Tensor, edges: Edges) -> Tensor:
    """Sum the terms of all pairs of each receiver."""
    return terms.new_zeros(edges.num_receivers, *terms.shape[1:]).index_add(0, edges.receivers, terms)
