r"""SPH relaxation: a shift of positions by pressure and viscosity that spreads particles evenly.

.. math::
    a = \alpha \left( -\frac{1}{\rho} \nabla p + \beta \nabla^2 u \right), \qquad x \leftarrow x + a

repeated a few times (Neural SPH, eqs. 5 and 6), in units in which the particle spacing, the mass of a particle and
the time between frames are 1. Nothing but positions enters: u is the displacement from the frame before. Densities
are sums over neighbours with the quintic spline, h = dx, and the pressure is that of a fluid with a speed of sound of
10. Densities below 0.98 of that at rest count as at rest, so that free surfaces and single layers of wall particles
hardly attract the fluid (only the second row of a lattice, whose density is 0.99, by 0.2 % of a spacing in a loop
with α = 0.02). Those above 1.02 count as 1.02, so that clusters drift apart instead of exploding. Wall particles take
pressure and velocity from the fluid near them and do not move.

Source: Toshev, Erbesdobler, Adams, Brandstetter, "Neural SPH: Improved Neural Modeling of Lagrangian Fluid Dynamics"
(ICML 2024). The text says nothing of walls beyond their single layer; here pressures are extrapolated to all of them,
as in the authors' code wherever their data have walls. Differences from that code: only the periodic axes of the box
wrap, where it wraps all of them; the constant of the kernel in three dimensions is 1/(120π), where it has 3/(359π),
0.28 % more.

Sums over pairs are those of the solver, compiled for the CPU (`compiled_relaxation`); other devices take torch
operations (`tensor_relaxation`).
"""

import math
from typing import Any, Protocol

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from cconv.domain import Box
from cconv.errors import ConfigError, ShapeError, SimulationError, check_shape
from cconv.sph.compiled_relaxation import CompiledParticles
from cconv.sph.tensor_relaxation import TensorParticles

FARTHEST_SHIFT = 1.0  # particle spacings in a loop


def relax(
    positions: Float[Tensor, "N D"],
    before: Float[Tensor, "N D"],
    is_wall: Bool[Tensor, " N"],
    *,
    box: Box,
    particle_spacing: float,
    alpha: float,
    beta: float = 0.0,
    loops: int = 1,
) -> Float[Tensor, "N D"]:
    """Positions after `loops` shifts of the fluid by pressure and viscosity, see the module for the equations.

    At rest every particle fills dx^D, whatever its mass, so no density has to be known. Particles at exactly the same
    place do not push each other apart. The shifts are computed in float64, where the device of the positions has it;
    derivatives do not pass.

    Args:
        positions: x (N, D), length.
        before: Positions a frame earlier (N, D), from which displacements are; used only with `beta`.
        is_wall: Which particles are walls (N,), bool; these keep their places.
        box: Domain with its periodic axes, each at least 6.6 particle spacings long.
        particle_spacing: dx, length.
        alpha: Size of the shift. The published values are 0.005 to 0.03.
        beta: Viscosity relative to the pressure. The published value is 0.2, or none.
        loops: How often particles are shifted. The published values are 1 to 5.

    Returns:
        Positions (N, D) of the same dtype and on the same device, within periodic axes.

    Raises:
        ConfigError: If a setting cannot be, or the box is too narrow.
        ShapeError: If shapes or dtypes do not fit, or a coordinate is not finite.
        SimulationError: If a loop shifts a particle by more than a particle spacing.
    """
    check_relaxation(alpha, beta, loops)
    _check_particles(positions, before, is_wall, box, particle_spacing)
    particles: type[_Particles] = CompiledParticles if positions.device.type == "cpu" else TensorParticles
    relaxed = particles(positions.detach(), before.detach(), is_wall, box, particle_spacing)
    for _ in range(loops):
        shifts = alpha * relaxed.shifts(beta)
        _check_shifts(shifts, particle_spacing, alpha)
        relaxed.move(shifts)
    return torch.where(is_wall[:, None], positions, box.wrap(relaxed.positions.to(positions)))


class _Particles(Protocol):
    """Particles that are shifted; shifts are arrays or tensors."""

    def __init__(
        self, positions: Tensor, before: Tensor, is_wall: Tensor, box: Box, particle_spacing: float
    ) -> None: ...

    @property
    def positions(self) -> Tensor: ...

    def shifts(self, beta: float) -> Any: ...

    def move(self, shifts: Any) -> None: ...


def check_relaxation(alpha: float, beta: float, loops: int) -> None:
    """Raise `ConfigError` unless the settings of a relaxation can be."""
    for name, value in (("alpha", alpha), ("beta", beta)):
        if not 0 <= value < math.inf:
            raise ConfigError(f"`{name}` of a relaxation must be a number from 0 on, got {value}.")
    if loops < 1:
        raise ConfigError(f"`loops` of a relaxation must be at least 1, got {loops}.")


def _check_particles(positions: Tensor, before: Tensor, is_wall: Tensor, box: Box, particle_spacing: float) -> None:
    particles = len(positions)
    check_shape("positions", positions.shape, (particles, box.dim))
    check_shape("before", before.shape, (particles, box.dim))
    check_shape("is_wall", is_wall.shape, (particles,))
    if particles == 0 or is_wall.dtype != torch.bool:
        raise ShapeError(f"`is_wall` must be bool of at least one particle, got {particles} of {is_wall.dtype}.")
    if not (torch.isfinite(positions).all() and torch.isfinite(before).all()):
        raise ShapeError("`positions` and `before` must be finite, got NaN or infinity.")
    if not 0 < particle_spacing < math.inf:
        raise ConfigError(f"`particle_spacing` must be positive, got {particle_spacing}.")


def _check_shifts(shifts: np.ndarray | Tensor, particle_spacing: float, alpha: float) -> None:
    farthest = math.sqrt(float((shifts**2).sum(1).max())) / particle_spacing
    if not farthest <= FARTHEST_SHIFT:
        raise SimulationError(
            f"A relaxation with alpha {alpha:g} shifted a particle by {farthest:.3g} particle spacings in one loop, "
            f"and at most {FARTHEST_SHIFT:g} is allowed; take a smaller `alpha` or `beta`."
        )
