"""Data sets of arrays: particles as anybody's program has them, written as trajectories of a scene."""

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from cconv.data.hdf5 import write_splits
from cconv.data.metadata import DIFFERENCES, OWN_KEY, default_mass, default_mass_source
from cconv.data.source import LARGEST, SPLITS, STORED, Given, as_floats, uniform_masses
from cconv.data.splits import Block, checked_fractions, split_names
from cconv.data.trajectory import Boundary, ParticleType, Scene, Trajectory
from cconv.domain import Box
from cconv.errors import ConfigError, ShapeError

Progress = Callable[[Iterable, str], Iterable]
Array = Any  # what numpy makes an array of: lists, NumPy arrays, torch tensors on the CPU


@dataclass(frozen=True, kw_only=True)
class ParticleArrays:
    """The arrays of one trajectory: T frames of N particles in D dimensions, in any consistent units.

    Attributes:
        positions: (T, N, D), length.
        velocities: (T, N, D), length per time; None for central differences of positions.
        masses: (N,); None for rest density 1.
        particle_types: (N,), values of `ParticleType`: 0 fluid, 1 wall, 2 moving wall; None if all are fluid.
        viscosities: Kinematic viscosities (N,), or None.
        boundary_positions: Points of walls that do not move (B, D), or None.
        boundary_normals: Their unit normals (B, D), or None.

    Raises:
        ShapeError: If a shape does not fit.
        ConfigError: If an array holds no numbers, a NaN, an unknown type or no fluid.
    """

    positions: Array
    velocities: Array = None
    masses: Array = None
    particle_types: Array = None
    viscosities: Array = None
    boundary_positions: Array = None
    boundary_normals: Array = None

    def __post_init__(self):
        shape = np.shape(self.positions)
        if len(shape) != 3 or 0 in shape or shape[2] > 3:
            raise ShapeError(
                f"`positions` must have shape (frames, particles, dim) with dim 1 to 3, got {shape}. Stack the frames "
                "first, and give frames of different numbers of particles as trajectories of their own."
            )
        frames, particles, dim = shape
        points = len(self.boundary_positions) if self.boundary_positions is not None else 0
        for name, wanted in (
            ("positions", shape),
            ("velocities", shape),
            ("masses", (particles,)),
            ("particle_types", (particles,)),
            ("viscosities", (particles,)),
            ("boundary_positions", (points, dim)),
            ("boundary_normals", (points, dim)),
        ):
            if getattr(self, name) is not None:
                object.__setattr__(self, name, _checked(getattr(self, name), name, wanted))
        self._check_types()

    def __len__(self) -> int:
        return len(self.positions)

    def _check_types(self) -> None:
        if self.particle_types is None:
            return
        unknown = set(np.unique(self.particle_types).tolist()) - {int(kind) for kind in ParticleType}
        if unknown or ParticleType.FLUID not in self.particle_types:
            known = ", ".join(f"{int(kind)} ({kind.name.lower()})" for kind in ParticleType)
            what = f"has unknown values {sorted(unknown)[:5]}" if unknown else "has no fluid"
            raise ConfigError(f"`particle_types` {what}; known are {known}, and some particles must be fluid.")


@dataclass(frozen=True, kw_only=True)
class SceneFacts:
    """What the trajectories of a data set share, in the units of their arrays.

    Attributes:
        particle_spacing: Distance of neighbouring particles at rest, dx.
        frame_dt: Time between frames.
        box: Bounds and periodic axes; None for open bounds around all particles of the first trajectory.
        force: Constant external acceleration, D numbers; None if there is none or it is not known.
        name: Short name of the scene; None for that of the folder.
        missing: A line for each fact that the data lack, with what stands for it.
        mass_source: Where masses come from, if there are any.

    Raises:
        ConfigError: If a number is not positive, or far too small or large.
    """

    particle_spacing: float
    frame_dt: float
    box: Box | None = None
    force: Sequence[float] | None = None
    name: str | None = None
    missing: Sequence[str] = field(default=())
    mass_source: str = STORED

    def __post_init__(self):
        self.given()

    def given(self) -> Given:
        """Numbers of the scene, checked as those that a user gives."""
        force = None if self.force is None else tuple(self.force)
        return Given(particle_spacing=self.particle_spacing, frame_dt=self.frame_dt, force=force)


def write_dataset(
    folder: str | Path,
    trajectories: Sequence[ParticleArrays],
    scene: SceneFacts,
    *,
    runs: Sequence[str] | None = None,
    split_fractions: Sequence[float] = (0.7, 0.15, 0.15),
    gap: int = 2,
    data_seed: int = 0,
    overwrite: bool = False,
) -> None:
    """Write arrays as a data set in the LagrangeBench layout with our extras; the folder appears whole or not at all.

    Whole runs are split by a seeded permutation; a single one is cut in time.

    Args:
        folder: Where to write.
        trajectories: Arrays of each trajectory; all have velocities and masses, or none has.
        scene: What the trajectories share.
        runs: Name of the simulation that each trajectory is a part of, in order of time; they stay in one split. None
            if each is a simulation of its own.
        split_fractions: Shares of train, valid and test.
        gap: Frames, or trajectories, dropped between the splits of a single run.
        data_seed: Seed of the permutation.
        overwrite: Whether an older data set in `folder` may be replaced.

    Raises:
        ShapeError: If trajectories differ in their number of dimensions.
        ConfigError: If a setting cannot be, trajectories hold different arrays, or the folder must not be replaced.
        DataError: If there are too few frames or runs to split.
    """
    write_runs(
        Path(folder), trajectories, scene, runs, (checked_fractions(split_fractions, gap), gap, data_seed), overwrite
    )


def write_runs(
    folder: Path,
    trajectories: Sequence[ParticleArrays],
    scene: SceneFacts,
    runs: Sequence[str] | None,
    split: tuple[tuple[float, ...], int, int],
    overwrite: bool,
    progress: Progress = lambda items, label: items,
) -> None:
    """As `write_dataset`, with shares, gap and seed in one, for sequences that read a trajectory when it is asked for.

    Args:
        folder: Where to write.
        trajectories: Arrays of each trajectory.
        scene: What the trajectories share.
        runs: Name of the simulation that each is a part of, or None.
        split: Shares of the splits, gap and seed.
        overwrite: Whether an older data set may be replaced.
        progress: Wraps the trajectories of a split to show progress, given a label.
    """
    if len(trajectories) == 0:
        raise ConfigError("`trajectories` must hold at least one trajectory.")
    names = [f"{k:05d}" for k in range(len(trajectories))] if runs is None else list(runs)
    if len(names) != len(trajectories):
        raise ConfigError(f"`runs` must have one name a trajectory ({len(trajectories)}), got {len(names)}.")
    blocks = split_runs(names, lambda k: len(trajectories[k]), split, folder)
    first = trajectories[0]
    described = _scene(first, scene, folder)
    splits = {name: _Trajectories(trajectories, chosen, described, progress, name) for name, chosen in blocks.items()}
    runs_of = {name: sorted({names[int(block.trajectory)] for block in chosen}) for name, chosen in blocks.items()}
    own = {OWN_KEY: {"runs": runs_of}} if runs is not None and max(map(len, runs_of.values())) <= 1000 else {}
    write_splits(folder, described, splits, own, overwrite)


def split_runs(
    names: Sequence[str],
    num_frames: Callable[[int], int],
    split: tuple[tuple[float, ...], int, int],
    folder: Path,
) -> dict[str, list[Block]]:
    """Blocks of the trajectories of each split, named by their numbers; a run is in one split, or cut in time if alone.

    Args:
        names: Run of each trajectory.
        num_frames: Number of frames of the trajectory with a number.
        split: Shares of the splits, gap and seed.
        folder: Folder of the data, for messages.
    """
    members: dict[str, list[int]] = {}
    for number, name in enumerate(names):
        members.setdefault(name, []).append(number)
    fractions, gap, seed = split

    def length(name: str) -> int:
        return num_frames(members[name][0]) if len(members[name]) == 1 else len(members[name])

    cut = split_names(list(members), length, fractions, gap, seed, folder)
    return {
        split_name: [part for block in blocks for part in _parts(block, members[block.trajectory])]
        for split_name, blocks in zip(SPLITS, cut, strict=True)
    }


def _parts(block: Block, members: Sequence[int]) -> list[Block]:
    """A block of a run as blocks of the trajectories that it is made of."""
    if len(members) == 1:
        return [Block(str(members[0]), block.start, block.stop)]
    return [Block(str(number), 0, None) for number in members[block.start : block.stop]]


class _Trajectories:
    """Trajectories of a split, made one at a time when asked for; knows their number, for progress."""

    def __init__(
        self, arrays: Sequence[ParticleArrays], blocks: Sequence[Block], scene: Scene, progress: Progress, split: str
    ):
        self._arrays, self._blocks, self._scene = arrays, blocks, scene
        self._progress, self._split = progress, split

    def __len__(self) -> int:
        return len(self._blocks)

    def __iter__(self) -> Iterator[Trajectory]:
        return (self._trajectory(block) for block in self._progress(self._blocks, self._split))

    def _trajectory(self, block: Block) -> Trajectory:
        return _as_trajectory(self._arrays[int(block.trajectory)], block, self._scene)


def _scene(first: ParticleArrays, facts: SceneFacts, folder: Path) -> Scene:
    dim = first.positions.shape[2]
    box = facts.box or _bounds(first, facts.particle_spacing)
    if box.dim != dim:
        raise ShapeError(f"`box` must have {dim} axes, as `positions` have, got {box.dim}.")
    missing = {
        "velocities": f"not stored; {DIFFERENCES}" if first.velocities is None else None,
        "masses": f"not stored; rest density 1 times dx^{dim}" if first.masses is None else None,
        "force": "not stored and not given; unknown" if facts.force is None else None,
    }
    return Scene(
        name=facts.name or folder.absolute().name,
        dim=dim,
        particle_spacing=facts.particle_spacing,
        frame_dt=facts.frame_dt,
        box=box,
        force=facts.given().force_in(dim),
        has_boundary=_has_walls(first),
        velocity_source=DIFFERENCES if first.velocities is None else STORED,
        mass_source=default_mass_source(facts.particle_spacing, dim) if first.masses is None else facts.mass_source,
        missing=(*(f"{topic}: {line}" for topic, line in missing.items() if line), *facts.missing),
    )


def _has_walls(arrays: ParticleArrays) -> bool:
    types = arrays.particle_types
    walls = (ParticleType.SOLID_WALL, ParticleType.MOVING_WALL)
    return arrays.boundary_positions is not None or (types is not None and bool(np.isin(types, walls).any()))


def _as_trajectory(arrays: ParticleArrays, block: Block, scene: Scene) -> Trajectory:
    """Frames of a trajectory, with what it must have in common with the first one."""
    if arrays.positions.shape[2] != scene.dim:
        raise ShapeError(
            f"trajectory {block.trajectory}: has {arrays.positions.shape[2]} dimensions, the first one {scene.dim}; "
            "write them as data sets of their own."
        )
    default = default_mass_source(scene.particle_spacing, scene.dim)
    has = {"velocities": scene.velocity_source == STORED, "masses": scene.mass_source != default}
    for name, wanted in has.items():
        if (getattr(arrays, name) is not None) != wanted:
            verb = "has no" if wanted else "has"
            raise ConfigError(
                f"trajectory {block.trajectory}: {verb} `{name}`, unlike the first one; give all or none."
            )
    frames = slice(block.start, block.stop)
    positions = as_floats(arrays.positions[frames])
    particles = positions.shape[1]
    mass = default_mass(scene.particle_spacing, scene.dim)
    return Trajectory(
        name=block.trajectory,
        first_frame=block.start,
        positions=positions,
        velocities=torch.zeros_like(positions) if arrays.velocities is None else as_floats(arrays.velocities[frames]),
        masses=uniform_masses(mass, positions) if arrays.masses is None else as_floats(arrays.masses),
        particle_types=_types(arrays, particles),
        boundary=_boundary(arrays),
        viscosities=None if arrays.viscosities is None else as_floats(arrays.viscosities),
    )


def _types(arrays: ParticleArrays, particles: int) -> Tensor:
    if arrays.particle_types is None:
        return torch.full((particles,), int(ParticleType.FLUID))
    return torch.from_numpy(arrays.particle_types.astype(np.int64))


def _boundary(arrays: ParticleArrays) -> Boundary | None:
    if arrays.boundary_positions is None:
        return None
    normals = None if arrays.boundary_normals is None else as_floats(arrays.boundary_normals)
    return Boundary(positions=as_floats(arrays.boundary_positions), normals=normals)


def _bounds(arrays: ParticleArrays, spacing: float) -> Box:
    """Open bounds around all particles and walls of a trajectory, half a spacing wider."""
    points = arrays.positions.reshape(-1, arrays.positions.shape[2])
    if arrays.boundary_positions is not None:
        points = np.concatenate([points, arrays.boundary_positions])
    return Box((points.min(axis=0) - spacing / 2).tolist(), (points.max(axis=0) + spacing / 2).tolist())


def _checked(values: Array, name: str, shape: tuple[int, ...]) -> np.ndarray:
    """An array of numbers of a shape, all of them finite."""
    array = np.asarray(values)
    if array.shape != shape:
        raise ShapeError(f"`{name}` must have shape {shape}, got {array.shape}.")
    if array.dtype.kind not in "fiu" or array.dtype.itemsize > 8:
        raise ConfigError(f"`{name}` must be numbers of at most 64 bits, got {array.dtype}.")
    if not (np.abs(array.astype(np.float64)) <= LARGEST).all():
        raise ConfigError(f"`{name}` has a NaN or a value beyond {LARGEST:g}; cut the trajectory before, or drop it.")
    return array
