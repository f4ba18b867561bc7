"""LagrangeBench folders: train.h5, valid.h5, test.h5 and metadata.json, read and written.

Each file has groups ``00000``, ``00001``, ... with `position` (T, N, D) and `particle_type` (N,). Optional members are
our extras: `velocity` (T, N, D), **length per time** (as JAX-SPH stores it; LagrangeBench's statistics are length per
frame), `mass` (N,), `viscosity` (N,), `boundary_position` (B, D) and `boundary_normal` (B, D).

Source: Toshev et al. (2023), LagrangeBench: A Lagrangian Fluid Mechanics Benchmarking Suite, and its data sets.
"""

import itertools
import json
import math
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path

import h5py
import numpy as np
import torch
from torch import Tensor

from cconv.data.folders import whole_folder
from cconv.data.hdf5_members import check_stored, linked
from cconv.data.limits import check_size, one_line
from cconv.data.metadata import (
    METADATA,
    default_mass,
    default_mass_source,
    load_metadata,
    metadata_from_scene,
    scene_from_metadata,
)
from cconv.data.source import SPLITS, STORED, Given, as_floats, as_tensor, check_array, check_finite, uniform_masses
from cconv.data.trajectory import Boundary, ParticleType, Scene, Trajectory, finite_difference_velocities
from cconv.domain import Box
from cconv.errors import CConvError, DataError

FILES = (*(f"{split}.h5" for split in SPLITS), METADATA)
BY_FRAME = ("position", "velocity")
FRAMES_PER_CHUNK = 8
LEAST_COMPRESSED = 0.5  # of the bytes of frames is what gzip leaves at least of particles in motion
CHUNK_BYTES = 2**24  # of a chunk of several frames, which is read whole for any of them
MOST_TRAJECTORIES = 100_000
LONGEST_NAME = 100


class LagrangeBenchSource:
    """Trajectories of a LagrangeBench folder or of one of ours.

    Velocities that are not stored are central differences of positions, masses that are not stored are ``dx ** D``
    (rest density 1). Wall particles at frame 0 are the boundary unless boundary points are stored. The force is the
    one that the case of the set is known for (dam break, reverse Poiseuille flow) or that our key declares by name; any
    other is only mentioned in `scene.missing`, and a force.py beside the data is never run. LagrangeBench marks sets
    with walls as periodic although their walls close the box: harmless, as no particle reaches an edge.

    Args:
        folder: Where the files are.
        given: What the user says about the data.

    Raises:
        DataError: If a file, key or member is missing, damaged or inconsistent.
        ConfigError: If the force does not have one number an axis.
    """

    format = "LagrangeBench"

    def __init__(self, folder: Path, given: Given):
        self.files = tuple(folder / name for name in FILES)
        _check_complete(folder, self.files)
        self._given = given
        self.metadata = load_metadata(folder / METADATA)
        self._file_of = {split: folder / f"{split}.h5" for split in SPLITS}
        self.stored_splits = {split: _trajectory_names(split, file) for split, file in self._file_of.items()}
        self.names = tuple(name for names in self.stored_splits.values() for name in names)
        with self._group(self.names[0]) as (file, group):
            types = _types(group, file, self.names[0], "particles")
            self.scene = scene_from_metadata(
                self.metadata,
                folder / METADATA,
                given,
                stores_velocity=_has(group, "velocity"),
                stores_mass=_has(group, "mass"),
                has_boundary=_has(group, "boundary_position") or bool(_is_wall(types).any()),
            )

    def num_frames(self, name: str) -> int:
        """Number of stored frames of a trajectory."""
        with self._group(name) as (file, group):
            return len(self._positions(group, file, name))

    def read(self, name: str, start: int = 0, stop: int | None = None) -> Trajectory:
        """Frames `start` to `stop` of a trajectory."""
        with self._group(name) as (file, group):
            stored = self._positions(group, file, name)
            frames = slice(start, stop)
            positions = _finite_frames(stored, frames, file, name)
            particles = positions.shape[1]
            types = _types(group, file, name, particles)
            return Trajectory(
                name=name,
                first_frame=start,
                positions=positions,
                velocities=self._velocities(group, file, name, positions, frames),
                masses=self._masses(group, file, name, positions),
                particle_types=types,
                boundary=_boundary(group, file, name, types),
                viscosities=_optional(group, "viscosity", file, name, (particles,)),
            )

    @contextmanager
    def _group(self, name: str) -> Iterator[tuple[Path, h5py.Group]]:
        split, _, group = name.partition("/")
        with _opened(self._file_of[split]) as file:
            yield self._file_of[split], linked(file, group, str(self._file_of[split]))

    def _positions(self, group: h5py.Group, file: Path, name: str) -> h5py.Dataset:
        stored, dim = _member(group, "position", file, name), self.scene.dim
        if stored.ndim != 3 or stored.shape[2] != dim or 0 in stored.shape or stored.dtype.kind != "f":
            raise DataError(
                f"{file}: trajectory {name}: `position` must be floating point of shape (frames, particles, {dim}), as "
                f"{METADATA} has dim {dim}, got {stored.dtype} of {stored.shape}; write it again or correct `dim`."
            )
        return stored

    def _velocities(self, group: h5py.Group, file: Path, name: str, positions: Tensor, frames: slice) -> Tensor:
        if self.scene.velocity_source != STORED:
            return finite_difference_velocities(positions, self.scene.frame_dt, self.scene.box)
        wanted, stored = self._positions(group, file, name).shape, _member(group, "velocity", file, name)
        if stored.shape != wanted:
            raise DataError(
                f"{file}: trajectory {name}: `velocity` must have the shape of `position` {wanted}, "
                f"got {stored.shape}; write it again or delete it to have differences of positions."
            )
        return _finite_frames(stored, frames, file, name)

    def _masses(self, group: h5py.Group, file: Path, name: str, positions: Tensor) -> Tensor:
        if self._given.mass:
            return uniform_masses(self._given.mass, positions)
        if self.scene.mass_source == default_mass_source(self.scene.particle_spacing, self.scene.dim):
            return uniform_masses(default_mass(self.scene.particle_spacing, self.scene.dim), positions)
        return _required(group, "mass", file, name, (positions.shape[1],))


def holds_hdf5(folder: Path) -> bool:
    """Whether `folder` has any file of the layout."""
    return any((folder / name).exists() for name in FILES)


def write_splits(
    folder: Path,
    scene: Scene,
    splits: Mapping[str, Iterable[Trajectory]],
    metadata: Mapping | None = None,
    overwrite: bool = False,
) -> None:
    """Write trajectories in the LagrangeBench layout with our extras; the folder appears whole or not at all.

    Velocities are written if the scene's are stored ones, masses unless they are the layout's default, viscosities and
    boundary points if there are any; wall particles are boundary points by themselves. The same trajectories give the
    same bytes.

    Args:
        folder: Where to write.
        scene: What the trajectories share.
        splits: Trajectories of "train", "valid" and "test"; read once, in this order, one at a time.
        metadata: Further keys of metadata.json (solver, viscosity, ...).
        overwrite: Whether an older data set in `folder` may be replaced.

    Raises:
        ConfigError: If the folder exists and must not be replaced.
        DataError: If a split has no trajectory.
    """
    with whole_folder(Path(folder), FILES, overwrite) as partial:
        summaries = {}
        for split in SPLITS:
            summaries[split] = Summary(scene.box)
            with h5py.File(partial / f"{split}.h5", "w") as file:
                for index, trajectory in enumerate(splits.get(split, ())):
                    _write_trajectory(file.create_group(f"{index:05d}"), trajectory, scene)
                    summaries[split].add_trajectory(trajectory)
            if not summaries[split].lengths:
                raise DataError(f"{folder}: split {split!r} has no trajectory; every split must have at least one.")
        write_metadata(partial, scene, metadata or {}, summaries)


class Summary:
    """Counts and step statistics of the fluid particles of trajectories, gathered one trajectory at a time."""

    def __init__(self, box: Box):
        self._box = box
        self.moments: dict[str, list[Tensor]] = {"vel": [], "acc": []}
        self.lengths: list[int] = []
        self.num_particles: list[int] = []

    def add_trajectory(self, trajectory: Trajectory) -> None:
        """Take in one more trajectory."""
        self.add_steps(trajectory.positions[:, trajectory.particle_types == ParticleType.FLUID])
        self.add_length(len(trajectory), trajectory.positions.shape[1])

    def add_steps(self, fluid: Tensor, most: int | None = None) -> None:
        """Take in the steps between frames of the fluid, and the changes of these steps.

        Args:
            fluid: Consecutive frames (T, M, D).
            most: Frames of which steps and changes begin, counted from the first; None for all.
        """
        steps = self._box.displacement(fluid[1:].double(), fluid[:-1].double())
        for name, values in (("vel", steps), ("acc", steps.diff(dim=0) if len(steps) else steps)):
            values = values[:most].flatten(0, 1)
            self.moments[name].append(torch.stack([torch.ones_like(values), values, values**2]).sum(dim=1))

    def add_length(self, num_frames: int, num_particles: int) -> None:
        """Take in how many frames and particles a trajectory has."""
        self.lengths.append(num_frames)
        self.num_particles.append(num_particles)


def write_metadata(folder: Path, scene: Scene, metadata: Mapping, summaries: Mapping[str, Summary]) -> None:
    """Write metadata.json of a folder whose splits have these statistics, with further keys."""
    complete = metadata_from_scene(scene, metadata, _statistics(summaries))
    (folder / METADATA).write_text(json.dumps(complete, indent=1) + "\n", encoding="utf-8")


def _statistics(summaries: Mapping[str, Summary]) -> dict:
    """Keys of metadata.json that follow from trajectories; lengths and steps in frames.

    Means and deviations are over all splits, as in the published sets. They are for LagrangeBench; our own networks
    standardise by training data only.
    """
    train, test = summaries["train"], summaries["test"]
    statistics: dict[str, int | list[float]] = {
        "sequence_length_train": min(train.lengths) - 1,
        "num_trajs_train": len(train.lengths),
        "sequence_length_test": min(test.lengths) - 1,
        "num_trajs_test": len(test.lengths),
        "num_particles_max": max(max(summary.num_particles) for summary in summaries.values()),
    }
    for name in ("vel", "acc"):
        moments = [moment for summary in summaries.values() for moment in summary.moments[name]]
        statistics[f"{name}_mean"], statistics[f"{name}_std"] = _mean_and_std(torch.stack(moments).sum(dim=0))
    return statistics


def _mean_and_std(moments: Tensor) -> tuple[list[float], list[float]]:
    """Mean and standard deviation from count, sum and sum of squares (3, D); zero where nothing was counted."""
    count, total, squares = moments
    mean = total / count.clamp(min=1)
    variance = squares / count.clamp(min=1) - mean**2
    return mean.tolist(), variance.clamp(min=0).sqrt().tolist()


def _write_trajectory(group: h5py.Group, trajectory: Trajectory, scene: Scene) -> None:
    _write(group, "position", trajectory.positions, by_frame=True)
    if scene.velocity_source == STORED:
        _write(group, "velocity", trajectory.velocities, by_frame=True)
    write_constants(group, trajectory, scene)


def write_constants(group: h5py.Group, trajectory: Trajectory, scene: Scene) -> None:
    """Write the members of a trajectory that are the same in every frame: types, masses, viscosities, walls."""
    boundary = trajectory.boundary
    _write(group, "particle_type", trajectory.particle_types)
    if scene.mass_source != default_mass_source(scene.particle_spacing, scene.dim):
        _write(group, "mass", trajectory.masses)
    if trajectory.viscosities is not None:
        _write(group, "viscosity", trajectory.viscosities)
    if boundary is not None and not _are_wall_particles(boundary, trajectory):
        _write(group, "boundary_position", boundary.positions)
        if boundary.normals is not None:
            _write(group, "boundary_normal", boundary.normals)


def _write(group: h5py.Group, key: str, values: Tensor, by_frame: bool = False) -> None:
    chunks = None
    if by_frame:
        frames = max(1, min(FRAMES_PER_CHUNK, len(values), CHUNK_BYTES // values[0].nbytes))
        chunks = (frames, *values.shape[1:])
    # Without times of creation in the file, the same values give the same bytes.
    group.create_dataset(key, data=values.cpu().numpy(), chunks=chunks, compression="gzip", track_times=False)


def _is_wall(types: Tensor) -> Tensor:
    return (types == ParticleType.SOLID_WALL) | (types == ParticleType.MOVING_WALL)


def _are_wall_particles(boundary: Boundary, trajectory: Trajectory) -> bool:
    walls = trajectory.positions[0, _is_wall(trajectory.particle_types)]
    return boundary.normals is None and torch.equal(boundary.positions, walls)


def _boundary(group: h5py.Group, file: Path, name: str, types: Tensor) -> Boundary | None:
    positions = _optional(group, "boundary_position", file, name, ("points", "dim"))
    if positions is not None:
        normals = _optional(group, "boundary_normal", file, name, tuple(positions.shape))
        return Boundary(positions=positions, normals=normals)
    wall = _is_wall(types)
    if not wall.any():
        return None
    return Boundary(positions=as_floats(_member(group, "position", file, name)[0])[wall], normals=None)


def _check_complete(folder: Path, files: Iterable[Path]) -> None:
    lacking = [file.name for file in files if not file.is_file()]
    if lacking:
        raise DataError(f"{folder}: {', '.join(lacking)} is missing; a LagrangeBench folder has {', '.join(FILES)}.")


def _trajectory_names(split: str, path: Path) -> tuple[str, ...]:
    with _opened(path) as file:
        members = itertools.islice(file, MOST_TRAJECTORIES + 1)
        names = tuple(f"{split}/{name}" for name in sorted(members) if _is_trajectory(file, name, path))
    if len(names) > MOST_TRAJECTORIES:
        raise DataError(f"{path}: has more than {MOST_TRAJECTORIES} trajectories; cut it into several sets.")
    if not names:
        raise DataError(f"{path}: has no trajectory; it must have groups 00000, 00001, ...: write or copy it again.")
    return names


@contextmanager
def _opened(path: Path) -> Iterator[h5py.File]:
    """An HDF5 file, with what h5py cannot read told in one line."""
    try:
        with h5py.File(path, "r") as file:
            yield file
    except CConvError:
        raise
    except (OSError, RuntimeError, KeyError, ValueError, TypeError, MemoryError, OverflowError) as error:
        what = "is empty" if path.stat().st_size == 0 else f"is truncated or not HDF5 ({one_line(error)})"
        raise DataError(f"{path}: {what}; copy it again.") from error


def _is_trajectory(file: h5py.File, name: str, path: Path) -> bool:
    if name.isprintable() and len(name) <= LONGEST_NAME:
        return isinstance(linked(file, name, str(path)), h5py.Group)
    raise DataError(f"{path}: a group is named {one_line(name)!r}; name trajectories 00000, 00001, ...")


def _has(group: h5py.Group, key: str) -> bool:
    """Whether there is such a link; nothing is followed."""
    return group.get(key, getlink=True) is not None


def _member(group: h5py.Group, key: str, file: Path, name: str) -> h5py.Dataset:
    """A data set that may be read: it was written, lies in the folder and fits into memory."""
    stored = linked(group, key, f"{file}: trajectory {name}")
    if not isinstance(stored, h5py.Dataset):
        found = one_line(", ".join(itertools.islice(group, 20))) or "nothing"
        raise DataError(f"{file}: trajectory {name}: `{key}` is missing (found: {found}); write it or copy it again.")
    check_stored(stored, file.parent, f"{file}: trajectory {name}: `{key}`", by_frame=key in BY_FRAME)
    return stored


def _types(group: h5py.Group, file: Path, name: str, particles: int | str) -> Tensor:
    """Types of the particles (N,), all of them known and at least one of them fluid."""
    types = as_tensor(_values(group, "particle_type", file, name, (particles,))).long()
    known = [int(kind) for kind in ParticleType]
    values, counts = types.unique(return_counts=True)
    unknown = [
        f"{value} ({count} times)"
        for value, count in zip(values.tolist(), counts.tolist(), strict=True)
        if value not in known
    ]
    if unknown:
        raise DataError(
            f"{file}: trajectory {name}: `particle_type` has unknown values {one_line(', '.join(unknown))}; "
            f"known are {', '.join(f'{int(kind)} ({kind.name.lower()})' for kind in ParticleType)}: correct them."
        )
    if ParticleType.FLUID not in types:
        raise DataError(
            f"{file}: trajectory {name}: no particle is fluid (`particle_type` 0); there is nothing to learn."
        )
    return types


def _required(group: h5py.Group, key: str, file: Path, name: str, shape: tuple[int | str, ...]) -> Tensor:
    return as_floats(_values(group, key, file, name, shape))


def _values(group: h5py.Group, key: str, file: Path, name: str, shape: tuple[int | str, ...]) -> np.ndarray:
    values = _member(group, key, file, name)[()]
    check_array(values, shape, file, f"trajectory {name}", key)
    check_finite(values[None], file, name, key)
    return values


def _optional(group: h5py.Group, key: str, file: Path, name: str, shape: tuple[int | str, ...]) -> Tensor | None:
    return _required(group, key, file, name, shape) if _has(group, key) else None


def _finite_frames(stored: h5py.Dataset, frames: slice, file: Path, name: str) -> Tensor:
    asked = len(range(*frames.indices(len(stored)))) * stored.dtype.itemsize * math.prod(stored.shape[1:])
    check_size(asked, asked, f"{file}: trajectory {name}")
    values = stored[frames]
    if len(values) == 0:
        raise DataError(f"{file}: trajectory {name} has {len(stored)} frames, none from {frames.start} on.")
    check_finite(values, file, name, stored.name.rsplit("/", 1)[-1], frames.start)
    return as_floats(values)
