"""Trajectories of the runs that are imported, read from their files when they are asked for."""

from collections.abc import Iterator, Sequence

import numpy as np

from cconv.data.arrays import ParticleArrays
from cconv.data.importing.masses import Masses
from cconv.data.importing.particles import Particles
from cconv.data.importing.runs import Run
from cconv.data.importing.scan import FrameReader
from cconv.data.limits import memory_limit
from cconv.data.trajectory import ParticleType
from cconv.errors import DataError


class ImportedTrajectories(Sequence[ParticleArrays]):
    """Trajectories of runs: one a run, or one a frame; the last one that was read is kept.

    Args:
        runs: The runs.
        frames: Reads their frames.
        axes: Axes that are kept.
        masses: Masses of particles.
        separate: Whether each frame is a trajectory.
        walls_move: Whether walls from files of their own move.
        frame_dt: Time between frames.
    """

    def __init__(
        self,
        runs: Sequence[Run],
        frames: FrameReader,
        axes: Sequence[int],
        masses: Masses,
        separate: bool,
        walls_move: bool,
        frame_dt: float,
    ):
        self._frames, self._axes, self._masses, self._walls_move = frames, list(axes), masses, walls_move
        whole = [(run, range(len(run))) for run in runs]
        single = [(run, range(k, k + 1)) for run in runs for k in range(len(run))]
        self._parts = single if separate else whole
        self._separate, self._frame_dt = separate, frame_dt
        self._last: tuple[int, ParticleArrays] | None = None

    @property
    def runs(self) -> tuple[str, ...]:
        """Name of the run of each trajectory."""
        return tuple(run.name for run, _ in self._parts)

    @property
    def description(self) -> str:
        """What becomes of the runs, in words."""
        if self._separate:
            return f"a trajectory for each of {len(self._parts)} frames: for fields, not for steps"
        return f"{len(self._parts)} " + ("trajectory" if len(self._parts) == 1 else "trajectories")

    def __len__(self) -> int:
        return len(self._parts)

    def __getitem__(self, index):
        if self._last is None or self._last[0] != index:
            self._last = index, self._read(*self._parts[index])
        return self._last[1]

    def __iter__(self) -> Iterator[ParticleArrays]:
        return (self[index] for index in range(len(self)))

    def _read(self, run: Run, chosen: range) -> ParticleArrays:
        first = self._frames.fluid_of(run, chosen[0])
        walls = self._frames.walls_of(run, chosen[0])
        joins_walls = walls is not None and self._walls_move and not self._separate
        _check_memory(first, len(chosen), run)
        frames = [self._frames.fluid_of(run, k) for k in chosen]
        moving = [self._frames.walls_of(run, k) for k in chosen] if joins_walls else []
        solids = [each for each in moving if each is not None]
        still = None if joins_walls else walls
        normals = None if still is None else still.values.get("normal")
        viscosities = first.values.get("viscosity")
        added = len(solids[0]) if solids else 0
        return ParticleArrays(
            positions=_stacked([each.positions for each in frames], [each.positions for each in solids], self._axes),
            velocities=self._velocities(frames, solids),
            masses=self._masses.values(first, added),
            particle_types=np.append(first.types, np.full(added, int(ParticleType.MOVING_WALL))),
            viscosities=None if viscosities is None or added else viscosities,
            boundary_positions=None if still is None else still.positions[:, self._axes],
            boundary_normals=None
            if still is None or normals is None
            else _unit(components_on(self._axes, normals, still)),
        )

    def _velocities(self, frames: Sequence[Particles], solids: Sequence[Particles]) -> np.ndarray | None:
        """Velocities (T, N, D); those of moving walls are differences where their files hold none."""
        if any("velocity" not in each.values for each in frames):
            return None
        fluid = np.stack([components_on(self._axes, each.values["velocity"], each) for each in frames])
        if not solids:
            return fluid
        if all("velocity" in each.values for each in solids):
            moving = np.stack([components_on(self._axes, each.values["velocity"], each) for each in solids])
        else:
            positions = np.stack([each.positions for each in solids])[..., self._axes]
            moving = np.gradient(positions, self._frame_dt, axis=0).astype(positions.dtype)
        return np.concatenate([fluid, moving], axis=1)


def components_on(axes: Sequence[int], values: np.ndarray, of: Particles) -> np.ndarray:
    """Components of vectors (N, C) of particles on the axes that are kept, (N, D).

    Raises:
        DataError: If they have another number of components than the positions, or than there are axes.
    """
    components = of.positions.shape[1]
    if values.shape[1] == len(axes):
        return values
    if values.shape[1] > components and not values[:, components:].any():
        values = values[:, :components]  # a third component that is always zero
    if values.shape[1] != components:
        raise DataError(
            f"{of.file}: vectors have {values.shape[1]} components, positions {components}; write both with as many."
        )
    return values[:, axes]


def _stacked(frames: Sequence[np.ndarray], solids: Sequence[np.ndarray], axes: list[int]) -> np.ndarray:
    """Positions (T, N, D) of frames, with the wall particles of each after them."""
    if solids:
        frames = [np.concatenate(parts) for parts in zip(frames, solids, strict=True)]
    return np.stack(frames)[..., axes]


def _unit(normals: np.ndarray) -> np.ndarray:
    lengths = np.linalg.norm(normals, axis=1, keepdims=True)
    return normals / np.where(lengths > 0, lengths, 1)


def _check_memory(first: Particles, frames: int, run: Run) -> None:
    size = 4 * frames * first.positions.nbytes  # positions and velocities, twice while they are put together
    if size > memory_limit():
        raise DataError(
            f"{run.name}: takes {size / 1e9:.3g} GB, more than half of the free memory; import fewer frames."
        )
