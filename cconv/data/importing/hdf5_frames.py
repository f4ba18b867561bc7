"""HDF5 files that hold one frame each, or a few arrays of frames, in members of any name, as DPI-Net and PySPH do."""

import itertools
from collections.abc import Iterator
from pathlib import Path

import h5py
import numpy as np

from cconv.data.hdf5_members import check_stored, linked
from cconv.data.importing.table import Table, stacked_tables
from cconv.data.limits import one_line
from cconv.errors import DataError

DEEPEST = 5  # groups inside each other
MOST_MEMBERS = 1000


def read_hdf5(file: Path) -> list[Table]:
    """Frames of an HDF5 file, by the last part of its members' names, or their whole names where that is not unique.

    Raises:
        DataError: If a member leads out of the file, was not written or is larger than memory.
    """
    with h5py.File(file, "r") as opened:
        members = list(itertools.islice(_members(opened, "", file), MOST_MEMBERS + 1))
        if len(members) > MOST_MEMBERS:
            raise DataError(f"{file}: has more than {MOST_MEMBERS} members; import files of one frame each.")
        leaves = [path.rsplit("/", 1)[-1] for path, _ in members]
        arrays = {}
        for (path, values), leaf in zip(members, leaves, strict=True):
            arrays[leaf if leaves.count(leaf) == 1 else path] = values
    return stacked_tables(file, arrays)


def _members(group: h5py.Group, path: str, file: Path, depth: int = 0) -> Iterator[tuple[str, np.ndarray]]:
    """Names and values of all arrays of numbers in a group and the groups in it."""
    for name in group:
        member = linked(group, name, str(file))
        inner = f"{path}/{name}" if path else name
        if isinstance(member, h5py.Group) and depth < DEEPEST:
            yield from _members(member, inner, file, depth + 1)
        elif isinstance(member, h5py.Dataset) and member.dtype.kind in "fiu" and member.shape and member.size:
            check_stored(member, file.parent, f"{file}: `{one_line(inner)}`")
            yield inner, member[()]
