"""Members of HDF5 files that may come from anybody: nothing outside their folder is read, nothing too large is begun.

HDF5 follows links to other files, reads raw bytes from any path, fills what was never written with zeros, and takes the
size of an array from a few bytes of a header. Each member is checked for this before a value of it is read.
"""

import math
import os
import stat
from pathlib import Path

import h5py

from cconv.errors import DataError, shown

COMPRESSION = 1100  # declared bytes by stored ones, at most; gzip reaches 1032 for zeros
SMALLEST = 2**20  # bytes that any array may have, whatever is stored
DEEPEST_SOURCE = 8  # virtual arrays of virtual arrays
SAME_FILE = "."


def linked_member(group: h5py.Group, key: str, file: Path) -> h5py.Group | h5py.Dataset | None:
    """The group or array `key` of a group; None if there is none.

    Args:
        group: Where to look.
        key: Name of the member.
        file: The file that was opened; what its links reach must lie in its folder.

    Raises:
        DataError: If a link leads nowhere or out of the folder.
    """
    link = group.get(key, getlink=True)
    if link is None:
        return None
    if isinstance(link, h5py.ExternalLink):
        _check_inside(file, link.filename, f"{shown(key)} is a link to")
    try:
        member = group[key]
    except KeyError as error:
        raise DataError(
            f"{file}: {shown(key)} is a link that leads nowhere ({error}); copy what it links to."
        ) from error
    _check_inside(file, member.file.filename, f"{shown(key)} links to")
    return member


def check_readable(stored: h5py.Dataset, file: Path, place: str, key: str) -> None:
    """Check that an array holds numbers which were written, are of a size that can be, and can be decoded.

    Args:
        stored: The array.
        file: Its file.
        place: Where it is, for messages, such as "trajectory 00000".
        key: Its name.

    Raises:
        DataError: With file, place, key and what is wrong.
    """
    where = f"{file}: {place}: `{key}`"
    kind = stored.dtype.kind
    if kind not in "fiu" or stored.dtype.itemsize > 8:
        raise DataError(f"{where} must hold numbers of at most 64 bits, got {stored.dtype}; write it again.")
    if stored.shape is None:
        raise DataError(f"{where} is empty; write it again.")
    _check_filters(stored, where)
    _check_sources(stored, file, where)
    _check_size(stored, file, where)
    _check_written(stored, where)


def _check_inside(file: Path, target: str, what: str) -> None:
    """Raise `DataError` unless a file that another one names is a regular one in its folder, or below."""
    folder = file.parent.resolve()
    path = (folder / target).resolve()
    if not path.is_relative_to(folder) and path != file.resolve():
        raise DataError(
            f"{file}: {what} {shown(target)}, outside the data's folder; copy what it links to into the file."
        )
    if not path.exists() or not stat.S_ISREG(path.stat().st_mode):
        raise DataError(f"{file}: {what} {shown(target)}, which is not there; copy it to the data's folder.")


def _check_filters(stored: h5py.Dataset, where: str) -> None:
    properties = stored.id.get_create_plist()
    for number in range(properties.get_nfilters()):
        code, _, _, name = properties.get_filter(number)
        if not h5py.h5z.filter_avail(code):
            label = shown(name.decode(errors="replace"))
            raise DataError(
                f"{where} is compressed by filter {code} ({label}), which is not installed; install its plugin or "
                "write the data with gzip."
            )


def _check_sources(stored: h5py.Dataset, file: Path, where: str, depth: int = 0) -> None:
    """Check the files that an array's values lie in, where that is not its own."""
    if stored.external:
        raise DataError(
            f"{where} keeps its values in other files ({shown(stored.external[0][0])}); write it as a whole."
        )
    if not stored.is_virtual:
        return
    if depth == DEEPEST_SOURCE:
        raise DataError(f"{where} is a virtual array of virtual arrays, {depth} deep; write it as a whole.")
    for source in stored.virtual_sources():
        if "%" in source.file_name or "%" in source.dset_name:
            raise DataError(f"{where} takes its values from files of a pattern; write it as a whole.")
        if source.file_name == SAME_FILE:
            _check_source(stored.file, source.dset_name, file, where, depth)
        else:
            _check_inside(file, source.file_name, f"{where} takes its values from")
            with h5py.File(file.parent / source.file_name, "r") as other:
                _check_source(other, source.dset_name, file, where, depth)


def _check_source(other: h5py.File, name: str, file: Path, where: str, depth: int) -> None:
    member = other.get(name)
    if not isinstance(member, h5py.Dataset):
        raise DataError(f"{where} takes its values from {shown(name)}, which is not there; write it as a whole.")
    _check_inside(file, member.file.filename, f"{where} takes its values from")
    _check_sources(member, file, where, depth + 1)


def _check_size(stored: h5py.Dataset, file: Path, where: str) -> None:
    """Raise `DataError` unless an array's size goes with the bytes that are stored for it, and with the memory."""
    size = math.prod(stored.shape) * stored.dtype.itemsize
    on_disk = getattr(os.stat(file), "st_blocks", math.inf) * 512
    held = on_disk if stored.is_virtual else min(stored.id.get_storage_size(), on_disk)
    memory = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    if size > SMALLEST and size > COMPRESSION * held:
        raise DataError(
            f"{where} of shape {stored.shape} claims {size:,} bytes, and the file holds {held:,} of them; write it "
            "again."
        )
    if size > memory / 2:
        raise DataError(
            f"{where} has {size:,} bytes, more than half of this machine's memory ({memory:,}); split the trajectory."
        )


def _check_written(stored: h5py.Dataset, where: str) -> None:
    """Raise `DataError` if any part of an array was allocated and never written: it would be read as zeros."""
    if stored.is_virtual or 0 in stored.shape:
        return
    if stored.chunks is None:
        if stored.id.get_storage_size() == 0:
            raise DataError(f"{where} was never written, from frame 0 on; write it again.")
        return
    grid = [math.ceil(length / chunk) for length, chunk in zip(stored.shape, stored.chunks, strict=True)]
    if stored.id.get_num_chunks() >= math.prod(grid):
        return
    written: set[tuple[int, ...]] = set()
    stored.id.chunk_iter(lambda chunk: written.add(chunk.chunk_offset))
    missing = next(offset for offset in _offsets(grid, stored.chunks) if offset not in written)
    raise DataError(
        f"{where} was never written at frame {missing[0]}, and would be read as zeros; cut it there or write it again."
    )


def _offsets(grid: list[int], chunks: tuple[int, ...]):
    """First index of each chunk, the last axis fastest."""
    for number in range(math.prod(grid)):
        offset = []
        for length in reversed(grid):
            number, place = divmod(number, length)
            offset.append(place)
        yield tuple(place * chunk for place, chunk in zip(reversed(offset), chunks, strict=True))
