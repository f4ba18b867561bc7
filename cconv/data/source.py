"""The interface of readers of particle data, the values that users may override, and checks that readers share."""

from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import numpy as np
import torch
from torch import Tensor

from cconv.data.trajectory import Scene, Trajectory
from cconv.errors import ConfigError, DataError
from cconv.forces import ConstantForce

SPLITS = ("train", "valid", "test")
STORED = "stored"
SMALLEST, LARGEST = 1e-12, 1e12  # of a length, time, mass or acceleration, whatever its unit; their powers fit float32


@dataclass(frozen=True, kw_only=True)
class Given:
    """Values that the user gives in place of those of the data, in their units; None keeps the value of the data.

    Attributes:
        mass: Mass of every particle.
        particle_spacing: Initial distance of neighbouring particles, dx.
        frame_dt: Time between stored frames.
        force: Constant external acceleration, D numbers.

    Raises:
        ConfigError: If a mass, spacing or time is not positive, or a number is beyond `SMALLEST` and `LARGEST`.
    """

    mass: float | None = None
    particle_spacing: float | None = None
    frame_dt: float | None = None
    force: tuple[float, ...] | None = None

    def __post_init__(self):
        for name in ("mass", "particle_spacing", "frame_dt"):
            value = getattr(self, name)
            if value is not None and not SMALLEST <= value <= LARGEST:
                raise ConfigError(f"`{name}` must be positive, from {SMALLEST:g} to {LARGEST:g}, got {value}.")
        if self.force is not None:
            object.__setattr__(self, "force", tuple(float(value) for value in self.force))
            if not all(abs(value) <= LARGEST for value in self.force):
                raise ConfigError(f"`force` must be finite, at most {LARGEST:g}, got {self.force}.")

    def force_in(self, dim: int) -> ConstantForce | None:
        """The given force, after a check that it has one number an axis; None if none is given."""
        if self.force is not None and len(self.force) != dim:
            raise ConfigError(f"`force` must have one number an axis ({dim}), got {len(self.force)}.")
        return None if self.force is None else ConstantForce(self.force)


class TrajectorySource(Protocol):
    """A folder of particle data that can be read piece by piece.

    Attributes:
        format: Name of the layout.
        scene: Facts that all trajectories share.
        metadata: Further stored facts about the data; empty if there are none.
        files: The data files, in a fixed order.
        names: Names of all trajectories; unique, stored split first where there is one ("train/00000").
        stored_splits: Names by split, if files or folders define splits; else empty.
    """

    format: str
    scene: Scene
    metadata: dict
    files: tuple[Path, ...]
    names: tuple[str, ...]
    stored_splits: dict[str, tuple[str, ...]]

    def num_frames(self, name: str) -> int:
        """Number of stored frames of a trajectory."""

    def read(self, name: str, start: int, stop: int | None) -> Trajectory:
        """Frames `start` to `stop` (to the end if None) of a trajectory."""


def uniform_masses(mass: float, like: Tensor) -> Tensor:
    """Return the same mass for each of N particles, (N,), with dtype and device of positions (T, N, D)."""
    return torch.full((like.shape[1],), mass, dtype=like.dtype, device=like.device)


def as_tensor(array: np.ndarray) -> Tensor:
    """A tensor of its own memory, in native byte order; float32 and float64 stay as they are, float16 is widened."""
    dtype = np.dtype("f4") if array.dtype.kind == "f" and array.dtype.itemsize == 2 else array.dtype.newbyteorder("=")
    return torch.from_numpy(np.array(array, dtype=dtype, order="C"))


def as_floats(array: np.ndarray) -> Tensor:
    """As `as_tensor`, with whole numbers as float32."""
    values = as_tensor(array)
    return values if values.is_floating_point() else values.float()


def check_array(array: object, shape: tuple[int | str, ...], file: Path, place: str, key: str) -> None:
    """Raise `DataError` unless `array` is a numeric array of `shape`; strings in `shape` match any length."""
    wanted = ", ".join(str(axis) for axis in shape)
    if not isinstance(array, np.ndarray) or array.dtype.kind not in "fiu" or array.dtype.itemsize > 8:
        came = array.dtype if isinstance(array, np.ndarray) else type(array).__name__
        raise DataError(f"{file}: {place}: `{key}` must be numbers of shape ({wanted}), got {came}; write it again.")
    fits = array.ndim == len(shape) and all(
        isinstance(want, str) or want == have for want, have in zip(shape, array.shape, strict=True)
    )
    if not fits:
        raise DataError(f"{file}: {place}: `{key}` must have shape ({wanted}), got {array.shape}; write it again.")


def check_finite(frames: np.ndarray, file: Path, name: str, key: str, first_frame: int = 0) -> None:
    """Raise `DataError` that names the first of `frames` (T, ...) with a NaN or what no unit makes sense of."""
    limit = np.float64(LARGEST)  # float16 could not hold it
    finite = ((-limit <= frames) & (frames <= limit)).reshape(len(frames), -1).all(axis=1)
    if not finite.all():
        frame = first_frame + int(np.argmin(finite))
        raise DataError(
            f"{file}: trajectory {name}, frame {frame}: `{key}` has a NaN or a value beyond {LARGEST:g}; "
            "the simulation blew up: cut the trajectory before this frame or drop it."
        )
