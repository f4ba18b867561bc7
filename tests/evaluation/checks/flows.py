"""Flows that tests of stability run on: in a periodic box or a drop over a wall, in any dimension."""

import itertools
import math
from functools import lru_cache

import torch

from cconv.data.trajectory import Boundary, ParticleType, Scene, Trajectory
from cconv.domain import Box
from cconv.evaluation.checks.material import make_material
from cconv.tasks import task_named

SPACING = 0.1


@lru_cache
def flow_material(task: str, *, dim: int, walls: bool, periodic: bool):
    """What checks of a task are made of in a flow."""
    trajectory, scene = flow(dim, walls=walls, periodic=periodic, frames=7 if dim == 2 else 3)
    return make_material([trajectory], scene, task_named(task))


def velocities_at(positions: torch.Tensor) -> torch.Tensor:
    """A turning, straining flow of period 1, faster along the first axis."""
    phase = 2 * math.pi * positions
    velocities = 0.3 * torch.sin(phase)
    velocities[:, 0] += 0.3 * torch.sin(phase[:, 0])
    if positions.shape[1] > 1:
        velocities[:, 0] += 1.5 * torch.sin(phase[:, 1])
        velocities[:, 1] -= torch.sin(phase[:, 0])
    return velocities


def flow(dim: int, *, walls: bool, periodic: bool, frames: int = 7) -> tuple[Trajectory, Scene]:
    """A trajectory and its scene: a drop around the middle of the unit box, or fluid all over a periodic one."""
    generator = torch.Generator().manual_seed(0)
    ticks = (torch.arange(10, dtype=torch.float64) + 0.5) * SPACING
    lattice = torch.cartesian_prod(*[ticks] * dim).reshape(-1, dim)
    if not periodic:
        lattice = lattice[(lattice - 0.5).norm(dim=1) < 0.49]
    box = Box([0] * dim, [1] * dim, periodic)
    positions = [lattice + 0.15 * SPACING * (torch.rand(lattice.shape, generator=generator).double() - 0.5)]
    velocities, frame_dt = [], 0.02
    for _ in range(frames):
        velocities.append(velocities_at(positions[-1]))
        positions.append(box.wrap(positions[-1] + frame_dt * velocities[-1]))
    scene = Scene(
        name="flow", dim=dim, particle_spacing=SPACING, frame_dt=frame_dt, box=box, force=None, has_boundary=walls,
        velocity_source="stored", mass_source="stored", missing=(),
    )  # fmt: skip
    trajectory = Trajectory(
        name="flow", first_frame=0, positions=torch.stack(positions[:-1]).float(),
        velocities=torch.stack(velocities).float(), masses=torch.full((len(lattice),), SPACING**dim),
        particle_types=torch.full((len(lattice),), int(ParticleType.FLUID)), boundary=wall(dim) if walls else None,
    )  # fmt: skip
    return trajectory, scene


def wall(dim: int) -> Boundary:
    """Points below the last axis, normals into the fluid."""
    ticks = (torch.arange(10) + 0.5) * SPACING
    points = torch.tensor(list(itertools.product(*[ticks.tolist()] * (dim - 1), [-0.5 * SPACING])))
    return Boundary(positions=points, normals=torch.eye(dim)[-1:].expand_as(points).clone())
