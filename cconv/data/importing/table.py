"""What the reader of every file format returns: named arrays with a row for each particle."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from cconv.data.limits import one_line
from cconv.errors import DataError


@dataclass(frozen=True, kw_only=True)
class Table:
    """The particles of one frame as a file holds them.

    Attributes:
        file: The file.
        arrays: Numbers by their name in the file, (N,) or (N, C). Members of another length may stand among them.
        time: Time of the frame; None if the file does not tell.
    """

    file: Path
    arrays: dict[str, np.ndarray]
    time: float | None


def plain_array(values: np.ndarray) -> np.ndarray | None:
    """An array of numbers in native byte order, a single column as (N,); None for what is no numbers."""
    if values.dtype.kind == "b":
        values = values.astype("u1")
    if values.dtype.kind not in "fiu" or values.dtype.itemsize > 8:
        return None
    values = values.astype(values.dtype.newbyteorder("="))
    return values[:, 0] if values.ndim == 2 and values.shape[1] == 1 else values


def stacked_tables(file: Path, arrays: Mapping[str, np.ndarray]) -> list[Table]:
    """Tables of arrays that hold one frame, (N,) or (N, C), or several, (T, N, C).

    Arrays (T, N) and (T, C) cannot be told from those of one frame, so beside frames only arrays of three axes are
    taken frame by frame, a member of T numbers named "time" gives their times, and other ones are the same in all.

    Raises:
        DataError: If arrays have different numbers of frames.
    """
    plain = {name: values for name, each in arrays.items() if (values := plain_array(each)) is not None}
    counts = {name: len(values) for name, values in plain.items() if values.ndim == 3}
    if not counts:
        return [Table(file=file, arrays=plain, time=_single_time(plain))]
    if len(set(counts.values())) > 1:
        listed = ", ".join(f"`{one_line(name, 40)}` {count}" for name, count in counts.items())
        raise DataError(f"{file}: arrays have different numbers of frames ({listed}); write them again.")
    num_frames = next(iter(counts.values()))
    times = _times(plain, num_frames)
    return [
        Table(
            file=file,
            arrays={name: values[index] if name in counts else values for name, values in plain.items()},
            time=times[index],
        )
        for index in range(num_frames)
    ]


def _single_time(arrays: Mapping[str, np.ndarray]) -> float | None:
    """The value of the member that is called like a time and holds one number."""
    return next((float(each.ravel()[0]) for name, each in arrays.items() if is_time(name) and each.size == 1), None)


def _times(arrays: Mapping[str, np.ndarray], num_frames: int) -> list[float | None]:
    found = (each for name, each in arrays.items() if is_time(name) and each.shape == (num_frames,))
    times = next(found, None)
    return [None] * num_frames if times is None else times.astype(float).tolist()


def is_time(name: str) -> bool:
    """Whether a member is called as times usually are."""
    return name.lower().replace("_", "") in ("time", "times", "t", "timevalue", "simulationtime")
