"""Relaxed random states: particles are evenly spread, but not on a lattice.

Initial states are prepared as in LagrangeBench: particles start near a lattice and are moved by the transport velocity
until they are evenly spread.
"""

import torch
from torch import Tensor

from cconv.domain import Box
from cconv.scenes.walls import Walls, lattice
from cconv.sph.kernels import QuinticSpline
from cconv.sph.solver import EquationOfState, Scheme, WeaklyCompressibleSPH, largest_time_step

_JITTER = 0.3  # largest displacement from the lattice along an axis, in spacings
_VISCOSITY = 0.2  # in spacings times the speed of sound: motion dies out within some tens of steps


def relaxed(
    positions: Tensor, *, box: Box, walls: Walls, spacing: float, generator: torch.Generator, steps: int
) -> Tensor:
    """Move a lattice to random, evenly spread positions (N, D), float64, in a box that it fills.

    Args:
        positions: Lattice to start from (N, D).
        box: Domain with its periodic axes.
        walls: Walls that close the other axes.
        spacing: Particle spacing.
        generator: Source of the shaking.
        steps: How many steps to spread, a few hundred at least.
    """
    offsets = 2 * torch.rand(positions.shape, generator=generator, dtype=torch.float64) - 1
    shaken = torch.cat([positions + _JITTER * spacing * offsets, walls.positions])
    dim, fluid = positions.shape[1], len(positions)
    eos = EquationOfState(sound_speed=1.0)
    solver = WeaklyCompressibleSPH(
        kernel=QuinticSpline(spacing, dim),
        box=box,
        particle_spacing=spacing,
        equation_of_state=eos,
        scheme=Scheme(transport_pressure=eos.reference_pressure),
    )
    state = solver.initial_state(
        shaken,
        torch.zeros_like(shaken),
        masses=torch.full((len(shaken),), spacing**dim),
        viscosities=torch.full((len(shaken),), _VISCOSITY * spacing),
        is_wall=torch.arange(len(shaken)) >= fluid,
    )
    time_step = largest_time_step(
        particle_spacing=spacing, sound_speed=1.0, reference_speed=0.1, viscosity=_VISCOSITY * spacing
    )
    for _ in range(steps):
        state = solver.step(state, time_step)
    return state.positions[:fluid]


def glass(lower: Tensor, upper: Tensor, spacing: float, generator: torch.Generator, steps: int) -> Tensor:
    """Fill a box with relaxed particles (N, D), float64, not aligned to its sides, to cut bodies out of them.

    They are copies of one periodic cube, placed side by side from a random origin.
    """
    dim = len(lower)
    cells = {1: 64, 2: 32, 3: 12}[dim]
    side = cells * spacing
    cube = relaxed(
        lattice([cells] * dim, spacing, [0.0] * dim),
        box=Box([0.0] * dim, [side] * dim, periodic=True),
        walls=Walls.none(dim),
        spacing=spacing,
        generator=generator,
        steps=steps,
    )
    origin = lower - side * torch.rand(dim, generator=generator, dtype=torch.float64)
    copies = torch.ceil((upper - origin) / side).long().tolist()
    corners = lattice(copies, side, [0.0] * dim) - side / 2 + origin
    filled = (corners[:, None] + cube).flatten(0, 1)
    return filled[((filled >= lower) & (filled <= upper)).all(dim=1)]
