"""Folders of DeepLagrangianFluids records (`*.msgpack.zst`), as Ummenhofer et al. publish them.

A file is a zstd-compressed msgpack list of frames. The files of one simulation share the name before the last
underscore: ``sim_0001_00``, ``sim_0001_01``, ... Arrays are encoded as msgpack-numpy does, but decoded here, since
msgpack-numpy unpickles object arrays and pickles run code.

Source: Ummenhofer et al. (2020), Lagrangian Fluid Simulation with Continuous Convolutions, and its
``create_physics_records.py``.
"""

import math
import re
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any, BinaryIO, TypeVar

import msgpack
import numpy as np
import torch
import zstandard
from torch import Tensor

from cconv.data.limits import memory_limit, one_line
from cconv.data.source import SPLITS, STORED, Given, as_floats, check_array, check_finite, uniform_masses
from cconv.data.trajectory import Boundary, ParticleType, Scene, Trajectory
from cconv.domain import Box
from cconv.errors import DataError

SUFFIX = ".msgpack.zst"
REST_DENSITY = 1000.0
PARTICLE_SPACING = 0.05
LARGEST_WINDOW = 2**31  # bytes that zstd looks back at most
PIECE = 2**24  # bytes decompressed at a time
MOST_OBJECTS = 2_000_000  # keys, values and items in a file; a frame has about sixty
COPIES = 3  # of the content at the same time: bytes, decoded frames, stacked frames
Container = TypeVar("Container", dict, list)  # of msgpack


class DeepLagrangianFluidsSource:
    """Trajectories in a folder of `.msgpack.zst` files, or in its sub-folders train/, valid/ and test/.

    Neither spacing nor time between frames nor force is stored. Unless given, the spacing is the format's convention
    (twice the particle radius 0.025), the time between frames is fitted to positions and velocities, and the force is
    not known. Masses that are all zero are replaced by ``REST_DENSITY * dx ** D``. `scene.missing` says so.

    Args:
        folder: Where the files are.
        given: What the user says about the data.

    Raises:
        DataError: If a file is missing, damaged or inconsistent.
        ConfigError: If the force does not have one number an axis.
    """

    format = "DeepLagrangianFluids"

    def __init__(self, folder: Path, given: Given):
        self.metadata: dict = {}
        self._given = given
        self._parts = _find_parts(folder)
        self.files = tuple(part for parts in self._parts.values() for part in parts)
        self.names = tuple(self._parts)
        self.stored_splits = _stored_splits(self.names)
        self.scene = self._describe(folder.name)

    def num_frames(self, name: str) -> int:
        """Number of stored frames of a trajectory; reads only the beginning of its files."""
        return sum(_count_frames(part) for part in self._parts[name])

    def read(self, name: str, start: int = 0, stop: int | None = None) -> Trajectory:
        """Frames `start` to `stop` of a trajectory; reads only the files that hold them."""
        files, frames, boundary = self._read_frames(name, start, stop)
        positions = _stack(files, frames, name, "pos", start)
        velocities = _stack(files, frames, name, "vel", start)
        if velocities.shape != positions.shape:
            raise DataError(
                f"{files[0]}: trajectory {name}: `vel` must have the shape of `pos` {tuple(positions.shape)}, "
                f"got {tuple(velocities.shape)}; write it again."
            )
        return Trajectory(
            name=name,
            first_frame=start,
            positions=positions,
            velocities=velocities,
            masses=self._masses(files[0], frames[0], name, positions),
            particle_types=torch.full((positions.shape[1],), int(ParticleType.FLUID)),
            boundary=boundary,
            viscosities=_viscosities(files[0], frames[0], name, positions.shape[1]),
        )

    def _read_frames(self, name: str, start: int, stop: int | None) -> tuple[list[Path], list[dict], Boundary | None]:
        """Frames of a block, the file of each, and the block's boundary."""
        files, frames, boundaries, offset = [], [], [], 0
        for part in self._parts[name]:
            count = _count_frames(part)
            first, last = max(start - offset, 0), count if stop is None else min(stop - offset, count)
            offset += count
            if first < last:
                stored = _load(part)
                frames += stored[first:last]
                files += [part] * (last - first)
                boundaries.append(_boundary(part, stored[0]))
        if not frames:
            raise DataError(f"{self._parts[name][0]}: trajectory {name} has no frames {start} to {stop}.")
        _check_consecutive(files, frames, name)
        _check_same_boundary(files, boundaries, name)
        return files, frames, boundaries[0]

    def _masses(self, file: Path, frame: Mapping, name: str, positions: Tensor) -> Tensor:
        stored = None if self._given.mass else _stored_masses(file, frame, name, positions.shape[1])
        if stored is not None:
            return stored.to(positions.dtype)
        return uniform_masses(self._replacement_mass(positions.shape[2]), positions)

    def _replacement_mass(self, dim: int) -> float:
        spacing = self._given.particle_spacing or PARTICLE_SPACING
        return self._given.mass or REST_DENSITY * spacing**dim

    def _describe(self, folder_name: str) -> Scene:
        name = self.names[0]
        trajectory = self.read(name, 0, max(2, _count_frames(self._parts[name][0])))
        dim = trajectory.positions.shape[2]
        force = self._given.force_in(dim)
        spacing = self._given.particle_spacing or PARTICLE_SPACING
        frame_dt = self._given.frame_dt or _estimate_frame_dt(trajectory, self._parts[name][0])
        mass_source = self._mass_source(trajectory, dim)
        missing = {
            "particle spacing": None if self._given.particle_spacing else f"not stored; {spacing:g} by convention",
            "frame dt": None
            if self._given.frame_dt
            else f"not stored; {frame_dt:.6g} fitted to stored positions and velocities",
            "force": None if force else "not stored and not given; unknown",
            "masses": None if mass_source == STORED or self._given.mass else mass_source,
            "viscosity": "not stored or zero" if trajectory.viscosities is None else None,
            "boundary": None if trajectory.boundary else "no wall points stored",
        }
        return Scene(
            name=folder_name,
            dim=dim,
            particle_spacing=spacing,
            frame_dt=frame_dt,
            box=_bounds(trajectory, spacing),
            force=force,
            has_boundary=trajectory.boundary is not None,
            velocity_source=STORED,
            mass_source=mass_source,
            missing=tuple(f"{topic}: {line}" for topic, line in missing.items() if line),
        )

    def _mass_source(self, trajectory: Trajectory, dim: int) -> str:
        if self._given.mass:
            return f"given: {self._given.mass:g}"
        first = self._parts[trajectory.name][0]
        if _stored_masses(first, _load(first)[0], trajectory.name, trajectory.positions.shape[1]) is not None:
            return STORED
        return f"{REST_DENSITY:g} * dx^{dim} = {self._replacement_mass(dim):g}, as stored masses are zero"


def holds_records(folder: Path) -> bool:
    """Whether `folder` or one of its sub-folders train/, valid/ and test/ has `.msgpack.zst` files."""
    return any(any(place.glob(f"*{SUFFIX}")) for place in (folder, *(folder / split for split in SPLITS)))


def decode_array(record: dict) -> object:
    """The array or number that msgpack-numpy encoded as `record`; any other mapping as it is.

    Raises:
        DataError: If the dtype is not a plain boolean, integer or floating point one. Objects would be pickles, and
            unpickling runs code.
    """
    if "nd" in record:  # packed by an old msgpack, or unpacked and packed again
        record = {key.encode() if isinstance(key, str) else key: value for key, value in record.items()}
    if b"nd" not in record:
        return record
    dtype_name = record.get(b"type")
    if not isinstance(dtype_name, str) or not re.fullmatch(r"[<>|=]?[bfiu][1248]", dtype_name):
        raise DataError(
            f"an array has dtype {one_line(dtype_name)!r}; only plain numbers are read, as objects could run code."
        )
    try:
        values = np.frombuffer(record[b"data"], dtype=np.dtype(dtype_name))
        return values.reshape(record[b"shape"]) if record[b"nd"] else values.reshape(())[()]
    except (KeyError, TypeError, ValueError) as error:
        raise DataError(f"an array does not fit its description ({error}); write it again.") from error


def _find_parts(folder: Path) -> dict[str, tuple[Path, ...]]:
    """Files of each trajectory, in order of their part numbers; trajectories in order of split and name."""
    with_splits = [split for split in SPLITS if any((folder / split).glob(f"*{SUFFIX}"))]
    if with_splits and not {"train", "valid"} <= set(with_splits):
        raise DataError(
            f"{folder}: has {' and '.join(with_splits)} but must have both train/ and valid/ with *{SUFFIX} files; "
            "add the other, or put all files into one folder to have them split."
        )
    parts = {}
    for split in with_splits or [""]:
        numbered: dict[str, list[tuple[int, Path]]] = {}
        for file in (folder / split).glob(f"*{SUFFIX}"):
            name, number = _name_and_part(file)
            numbered.setdefault(f"{split}/{name}" if split else name, []).append((number, file))
        for name in sorted(numbered):
            parts[name] = tuple(file for _, file in sorted(numbered[name]))
    return parts


def _name_and_part(file: Path) -> tuple[str, int]:
    stem = file.name.removesuffix(SUFFIX)
    name, _, part = stem.rpartition("_")
    return (name, int(part)) if name and part.isdecimal() else (stem, 0)


def _stored_splits(names: tuple[str, ...]) -> dict[str, tuple[str, ...]]:
    by_split = {split: tuple(name for name in names if name.startswith(f"{split}/")) for split in SPLITS}
    return {split: members for split, members in by_split.items() if members}


def _count_frames(file: Path) -> int:
    """Number of frames in a file, from the head of its list."""
    unpacker = msgpack.Unpacker()
    try:
        with file.open("rb") as stream, _decompressed(stream) as reader:
            unpacker.feed(reader.read(5))
        count = unpacker.read_array_header()
    except (OSError, zstandard.ZstdError, msgpack.UnpackException, ValueError) as error:
        raise _damaged(file, error) from error
    if count == 0:
        raise DataError(f"{file}: has no frames; delete it or copy it again.")
    return count


def _load(file: Path) -> list[dict]:
    """All frames of a file."""
    try:
        frames = _unpack(_unpacked_bytes(file))
    except DataError as error:
        raise DataError(f"{file}: {error}") from error
    except (OSError, zstandard.ZstdError, msgpack.UnpackException, ValueError, TypeError, MemoryError) as error:
        raise _damaged(file, error) from error
    if not isinstance(frames, list) or not all(isinstance(frame, dict) for frame in frames):
        raise DataError(f"{file}: must hold a list of frames, each a mapping; copy or convert it again.")
    return frames


def _unpack(content: bytearray) -> object:
    """What msgpack holds, arrays decoded; refused where it is so many objects that they would not fit into memory."""
    count = 0

    def counted(values: Container) -> Container:
        nonlocal count
        count += 1 + len(values)
        if count > MOST_OBJECTS:
            raise DataError(f"holds more than {MOST_OBJECTS:,} objects, which no file of frames does; copy it again.")
        return values

    return msgpack.unpackb(
        content,
        raw=False,
        strict_map_key=False,
        object_hook=lambda values: decode_array(counted(values)),
        list_hook=counted,
        max_array_len=MOST_OBJECTS,
        max_map_len=MOST_OBJECTS,
    )


def _decompressed(stream: BinaryIO) -> zstandard.ZstdDecompressionReader:
    """A reader over all zstd frames of a stream, one after the other (pzstd writes several)."""
    return zstandard.ZstdDecompressor(max_window_size=LARGEST_WINDOW).stream_reader(stream, read_across_frames=True)


def _unpacked_bytes(file: Path) -> bytearray:
    """What a file decompresses to, refused as soon as it is more than fits into memory."""
    content, room = bytearray(), memory_limit() // COPIES
    with file.open("rb") as stream, _decompressed(stream) as reader:
        while piece := reader.read(PIECE):
            content += piece
            if len(content) > room:
                raise DataError(f"decompresses to more than the {room / 1e9:.3g} GB that fit into memory; cut it.")
    return content


def _damaged(file: Path, error: Exception) -> DataError:
    reason = one_line(error)
    what = "is empty" if file.stat().st_size == 0 else f"is truncated or not zstd-compressed msgpack ({reason})"
    return DataError(f"{file}: {what}; copy it again.")


def _member(file: Path, frame: Mapping, name: str, key: str) -> Any:
    if key not in frame:
        known = one_line(", ".join(str(known) for known in frame))
        raise DataError(f"{file}: trajectory {name}: key `{key}` is missing; frames must hold it (found: {known}).")
    return frame[key]


def _stack(files: list[Path], frames: list[dict], name: str, key: str, start: int) -> Tensor:
    """The arrays under `key` of all frames, (T, N, D)."""
    arrays: list[np.ndarray] = []
    for index, (file, frame) in enumerate(zip(files, frames, strict=True)):
        array = _member(file, frame, name, key)
        check_array(array, ("particles", "dim"), file, f"trajectory {name}, frame {start + index}", key)
        if array.shape != (arrays[0].shape if arrays else array.shape):
            raise DataError(
                f"{file}: trajectory {name}, frame {start + index}: `{key}` changes its shape from {arrays[0].shape} "
                f"to {array.shape}; the number of particles must not change: cut the trajectory there."
            )
        check_finite(array[None], file, name, key, start + index)
        arrays.append(array)
    return as_floats(np.stack(arrays))


def _check_consecutive(files: list[Path], frames: list[dict], name: str) -> None:
    ids = [_member(file, frame, name, "frame_id") for file, frame in zip(files, frames, strict=True)]
    if not all(isinstance(number, int | np.integer) for number in ids):
        raise DataError(f"{files[0]}: trajectory {name}: `frame_id` must be a whole number; write it again.")
    for file, earlier, later in zip(files[1:], ids[:-1], ids[1:], strict=True):
        if later != earlier + 1:
            raise DataError(
                f"{file}: trajectory {name}: `frame_id` jumps from {earlier} to {later}; "
                "frames must be consecutive: add the missing file or give the later ones another trajectory name."
            )


def _boundary(file: Path, frame: Mapping) -> Boundary | None:
    positions, normals = frame.get("box"), frame.get("box_normals")
    if positions is None or np.size(positions) == 0:
        return None
    check_array(positions, ("points", "dim"), file, "first frame", "box")
    check_finite(positions[None], file, "of the file", "box")
    if normals is not None:
        check_array(normals, positions.shape, file, "first frame", "box_normals")
        check_finite(normals[None], file, "of the file", "box_normals")
    return Boundary(positions=as_floats(positions), normals=None if normals is None else as_floats(normals))


def _check_same_boundary(files: list[Path], boundaries: list[Boundary | None], name: str) -> None:
    held = [boundary.positions for boundary in boundaries if boundary]
    if held and (boundaries[0] is None or any(not torch.equal(positions, held[0]) for positions in held)):
        raise DataError(
            f"{files[0]}: trajectory {name}: `box` differs between its files; walls must not move or change: "
            "make each file a trajectory of its own."
        )


def _stored_masses(file: Path, frame: Mapping, name: str, num_particles: int) -> Tensor | None:
    """Stored masses (N,), or None if they are all zero."""
    masses = _member(file, frame, name, "m")
    check_array(masses, (num_particles,), file, f"trajectory {name}", "m")
    check_finite(masses[None], file, name, "m")
    return as_floats(masses) if np.any(masses) else None


def _viscosities(file: Path, frame: Mapping, name: str, num_particles: int) -> Tensor | None:
    """Stored viscosities (N,), or None if there are none or all are zero."""
    viscosities = frame.get("viscosity")
    if viscosities is None or not np.any(viscosities):
        return None
    check_array(viscosities, (num_particles,), file, f"trajectory {name}", "viscosity")
    check_finite(viscosities[None], file, name, "viscosity")
    return as_floats(viscosities)


def _estimate_frame_dt(trajectory: Trajectory, file: Path) -> float:
    r"""Time between frames that fits steps to velocities best, :math:`x_{t+1} - x_t = \Delta t \, v`.

    Integrators differ in which velocity moved the particles: v is the earlier frame's, the later one's (semi-implicit
    Euler) or their mean, whichever leaves the smallest residual.
    """
    positions, velocities = trajectory.positions.double(), trajectory.velocities.double()
    steps, earlier, later = positions.diff(dim=0), velocities[:-1], velocities[1:]
    fits = list(map(partial(_least_squares, steps), (later, (earlier + later) / 2, earlier)))
    frame_dt = min(fits, key=lambda fit: fit[1])[0]
    if not 0 < frame_dt < math.inf:
        raise DataError(
            f"{file}: the time between frames is not stored and positions and velocities do not tell it "
            "(a single frame, or nothing moves); give frame_dt."
        )
    return frame_dt


def _least_squares(steps: Tensor, velocities: Tensor) -> tuple[float, float]:
    """Factor of velocities that fits steps best, and what remains (sum of squares)."""
    if not velocities.any():
        return math.nan, math.inf
    factor = (steps * velocities).sum() / velocities.square().sum()
    return float(factor), float((steps - factor * velocities).square().sum())


def _bounds(trajectory: Trajectory, spacing: float) -> Box:
    """Box of the wall points, or else of the first frame's particles, all axes open; flat axes get one spacing."""
    points = trajectory.positions[0] if trajectory.boundary is None else trajectory.boundary.positions
    lower, upper = points.amin(dim=0).tolist(), points.amax(dim=0).tolist()
    flat = [spacing / 2 if low == high else 0.0 for low, high in zip(lower, upper, strict=True)]
    return Box(
        [low - margin for low, margin in zip(lower, flat, strict=True)],
        [high + margin for high, margin in zip(upper, flat, strict=True)],
    )
