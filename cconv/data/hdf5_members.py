"""Members of HDF5 files from strangers: links stay in the file, sizes are checked before anything is read."""

import itertools
import math
from pathlib import Path

import h5py

from cconv.data.limits import check_size, one_line
from cconv.errors import DataError

DEEPEST = 8  # soft links or virtual data sets that lead to each other


def linked(group: h5py.Group, key: str, place: str, depth: int = 0) -> h5py.Group | h5py.Dataset | None:
    """The member `key` of a group, or None if there is none.

    Soft links within the file are followed. External links are not, since they can read any file of the user.

    Raises:
        DataError: If a link leaves the file or leads nowhere.
    """
    link = group.get(key, getlink=True)
    if link is None or isinstance(link, h5py.HardLink):
        return None if link is None else group[key]
    what = f"{place}: `{one_line(key)}`"
    if isinstance(link, h5py.ExternalLink):
        raise DataError(
            f"{what} is a link to another file ({one_line(link.filename)}), which is not followed; "
            "copy what it names into this file (h5copy)."
        )
    target = group.file if link.path.startswith("/") else group
    for part in filter(lambda part: part not in ("", "."), link.path.split("/")):
        target = linked(target, part, place, depth + 1) if isinstance(target, h5py.Group) and depth < DEEPEST else None
    if target is None:
        raise DataError(f"{what} is a link to {one_line(link.path)}, which leads nowhere; write it again.")
    return target


def check_stored(dataset: h5py.Dataset, folder: Path, place: str, depth: int = 0, by_frame: bool = False) -> None:
    """Raise `DataError` unless a data set holds numbers, lies in `folder`, fits into memory and was written whole.

    Args:
        dataset: What is about to be read; nothing of it is read here.
        folder: Folder of the data. Sources of virtual data sets may be files in it.
        place: File, trajectory and member, for messages.
        depth: How many virtual data sets led here.
        by_frame: Whether it is read frame by frame, so that only one has to fit.
    """
    _check_type(dataset, place)
    _check_filters(dataset, place)
    if dataset.external:
        named = one_line(dataset.external[0][0])
        raise DataError(f"{place} is kept outside the file ({named}), which is not read; write it into the file.")
    if dataset.is_virtual:
        _check_sources(dataset, folder, place, depth)
        return
    size = dataset.size * dataset.dtype.itemsize
    check_size(size, dataset.id.get_storage_size(), place, size // len(dataset) if by_frame else size)
    _check_written(dataset, place)


def _check_type(dataset: h5py.Dataset, place: str) -> None:
    kind, size = dataset.dtype.kind, dataset.dtype.itemsize
    if dataset.shape is None or dataset.shape == () or dataset.size == 0:
        raise DataError(f"{place} must be an array with values, got shape {dataset.shape}; write it again.")
    if kind not in "fiu" or size > 8:
        hint = "convert it to float64" if kind == "f" else "write it again"
        raise DataError(f"{place} must be numbers of at most 64 bits, got {one_line(dataset.dtype)}; {hint}.")


def _check_filters(dataset: h5py.Dataset, place: str) -> None:
    settings = dataset.id.get_create_plist()
    for index in range(settings.get_nfilters()):
        number = settings.get_filter(index)[0]
        if not h5py.h5z.filter_avail(number):
            raise DataError(
                f"{place} is compressed by HDF5 filter {number}, which is not installed; "
                "write it again with gzip (h5repack -f GZIP=4)."
            )


def _check_sources(dataset: h5py.Dataset, folder: Path, place: str, depth: int) -> None:
    """Check what a virtual data set is put together from."""
    sources, size = dataset.virtual_sources(), dataset.size * dataset.dtype.itemsize
    covered = sum(source.vspace.get_select_npoints() for source in sources)
    if covered < dataset.size:
        raise DataError(f"{place} is virtual and {dataset.size - covered} of its values have no source; copy it again.")
    for source in {(source.file_name, source.dset_name) for source in sources}:
        check_size(size, _source_bytes(source, Path(dataset.file.filename), folder, place, depth), place)


def _source_bytes(source: tuple[str, str], file: Path, folder: Path, place: str, depth: int) -> int:
    """Stored bytes of a checked source of a virtual data set."""
    name, member = source
    path = (file if name == "." else file.parent / name).resolve()
    if depth >= DEEPEST or not path.is_relative_to(folder.resolve()):
        raise DataError(
            f"{place} is read from {one_line(name)}, outside of its folder; write its values into the file."
        )
    if not path.is_file():
        raise DataError(f"{place} is read from {one_line(name)}, which is missing; copy that file as well.")
    with h5py.File(path, "r") as opened:
        target = opened
        for part in filter(None, member.split("/")):
            target = linked(target, part, str(path)) if isinstance(target, h5py.Group) else None
        if not isinstance(target, h5py.Dataset):
            raise DataError(f"{place} is read from {one_line(name)}, which has no `{one_line(member)}`; copy it again.")
        check_stored(target, folder, f"{path}: `{one_line(member)}`", depth + 1)
        return target.size * target.dtype.itemsize


def _check_written(dataset: h5py.Dataset, place: str) -> None:
    if dataset.chunks is None:
        if dataset.id.get_storage_size() < dataset.size * dataset.dtype.itemsize:
            raise DataError(f"{place} was made but never written (it would read as zeros); write it again.")
        return
    wanted = math.prod(-(-length // chunk) for length, chunk in zip(dataset.shape, dataset.chunks, strict=True))
    if dataset.id.get_num_chunks() < wanted:
        raise DataError(
            f"{place} was made but not written from frame {_first_unwritten(dataset)} on "
            "(it would read as zeros); write it again or cut the trajectory there."
        )


def _first_unwritten(dataset: h5py.Dataset) -> int:
    """Index along the first axis of the first chunk that is not in the file."""
    written: set[tuple[int, ...]] = set()
    dataset.id.chunk_iter(lambda chunk: written.add(tuple(chunk.chunk_offset)))
    starts = (range(0, length, chunk) for length, chunk in zip(dataset.shape, dataset.chunks, strict=True))
    return next(start[0] for start in itertools.product(*starts) if start not in written)
