"""The data that readers return: a scene, its trajectories, their frames."""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from enum import IntEnum
from typing import Protocol, runtime_checkable

import torch
from torch import Tensor

from cconv.devices import moved
from cconv.domain import Box
from cconv.errors import ConfigError
from cconv.forces import Force


class ParticleType(IntEnum):
    """Particle types as LagrangeBench stores them."""

    PAD = -1
    FLUID = 0
    SOLID_WALL = 1
    MOVING_WALL = 2
    RIGID = 3


@dataclass(frozen=True, kw_only=True)
class Boundary:
    """Points that represent the walls of a scene.

    Attributes:
        positions: (B, D), length.
        normals: Unit normals (B, D), or None where the data hold none.
        batch_index: Window that each point belongs to (B,) where there are several; None for one.
    """

    positions: Tensor
    normals: Tensor | None
    batch_index: Tensor | None = None

    def to(self, device: torch.device) -> "Boundary":
        """The same on a device."""
        return moved(self, device, ("positions", "normals", "batch_index"))


@dataclass(frozen=True, kw_only=True)
class Scene:
    """Facts that all trajectories of a data set share. Lengths and times are in the units of the data.

    Attributes:
        name: Short name of the scene.
        dim: Number of space dimensions D.
        particle_spacing: Initial distance of neighbouring particles, dx.
        frame_dt: Time between stored frames.
        box: Bounds and periodic axes.
        force: External acceleration as a function of the position, or None if there is none or it is not known.
        has_boundary: Whether there are wall points or wall particles.
        velocity_source: Where velocities come from: "stored" or "central differences of positions".
        mass_source: Where masses come from: "stored", or the value that stands in for them and why.
        missing: One line for every fact that the data lack, with the default that replaces it.
    """

    name: str
    dim: int
    particle_spacing: float
    frame_dt: float
    box: Box
    force: Force | None
    has_boundary: bool
    velocity_source: str
    mass_source: str
    missing: tuple[str, ...]


@dataclass(frozen=True, kw_only=True)
class Frame:
    """All particles at one stored time.

    Attributes:
        positions: (N, D), length.
        velocities: (N, D), length per time.
        masses: (N,).
        particle_types: (N,), int64, values of `ParticleType`.
        boundary: Wall points, or None.
    """

    positions: Tensor
    velocities: Tensor
    masses: Tensor
    particle_types: Tensor
    boundary: Boundary | None

    @property
    def device(self) -> torch.device:
        """Where the particles are stored."""
        return self.positions.device

    def to(self, device: torch.device) -> "Frame":
        """The same on a device."""
        return moved(self, device, ("positions", "velocities", "masses", "particle_types", "boundary"))


@dataclass(frozen=True, kw_only=True)
class Trajectory:
    """Consecutive frames of one simulation.

    Attributes:
        name: Name of the trajectory in its file or folder.
        first_frame: Index of the first frame here within the stored trajectory.
        positions: (T, N, D), length.
        velocities: (T, N, D), length per time.
        masses: (N,).
        particle_types: (N,), int64.
        boundary: Wall points of all frames, or None.
        viscosities: Kinematic viscosity of each particle (N,), or None where the data hold none.
    """

    name: str
    first_frame: int
    positions: Tensor
    velocities: Tensor
    masses: Tensor
    particle_types: Tensor
    boundary: Boundary | None
    viscosities: Tensor | None = None

    def __len__(self) -> int:
        return len(self.positions)

    def __getitem__(self, index: int) -> Frame:
        return Frame(
            positions=self.positions[index],
            velocities=self.velocities[index],
            masses=self.masses,
            particle_types=self.particle_types,
            boundary=self.boundary,
        )

    def __iter__(self) -> Iterator[Frame]:
        return (self[index] for index in range(len(self)))

    def between(self, start: int, stop: int) -> "Trajectory":
        """Some of the frames, from `start` up to `stop`, counted from the first one here; memory is shared."""
        frames = slice(start, stop)
        first = self.first_frame + start
        return replace(self, first_frame=first, positions=self.positions[frames], velocities=self.velocities[frames])


@runtime_checkable
class Frames(Protocol):
    """Consecutive frames of one simulation, in memory as a `Trajectory` or read when they are asked for.

    Attributes:
        name: Name of the trajectory in its file or folder.
        first_frame: Index of the first frame here within the stored trajectory.
        particle_types: (N,), int64.
        boundary: Wall points of all frames, or None.
    """

    @property
    def name(self) -> str: ...

    @property
    def first_frame(self) -> int: ...

    @property
    def particle_types(self) -> Tensor: ...

    @property
    def boundary(self) -> Boundary | None: ...

    def __len__(self) -> int: ...

    def __getitem__(self, index: int) -> Frame: ...

    def between(self, start: int, stop: int) -> Trajectory: ...


def time_of(trajectory: Frames, index: int, frame_dt: float) -> float:
    """Time of a frame since the start of the stored trajectory."""
    return (trajectory.first_frame + index) * frame_dt


def check_frames(trajectory: Frames, frames: Iterable[int]) -> None:
    """Raise `ConfigError` unless there is at least one frame and all are frames of the trajectory, counted from 0."""
    frames, last = list(frames), len(trajectory) - 1
    outside = [index for index in frames if not 0 <= index <= last]
    if outside or not frames:
        raise ConfigError(f"`frames` must be numbers from 0 to {last}, got {outside[0] if outside else 'none'}.")


def finite_difference_velocities(positions: Tensor, frame_dt: float, box: Box) -> Tensor:
    """Velocities (T, N, D) from positions (T, N, D): central differences, one-sided at both ends.

    Steps are minimum-image displacements. A single frame has velocity zero.
    """
    if len(positions) == 1:
        return torch.zeros_like(positions)
    steps = box.displacement(positions[1:], positions[:-1]) / frame_dt
    central = (steps[1:] + steps[:-1]) / 2
    return torch.cat([steps[:1], central, steps[-1:]])
