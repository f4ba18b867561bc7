"""Series of files: which files belong together, in which order, at which times; one series a simulation and body."""

import glob
import json
import re
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

from cconv.data.importing.formats import READERS, read_tables
from cconv.data.importing.table import Table
from cconv.data.importing.vtk_xml import read_collection
from cconv.data.limits import memory_limit, one_line
from cconv.errors import DataError
from cconv.files import read_json

COLLECTION, SERIES = ".pvd", ".series"  # files that name others
PACKED = ".msgpack.zst"  # DeepLagrangianFluids, whose folders are read as they are
SHARE = 4  # of the memory that data may take is for files that were read
IRREGULAR = 0.01  # largest difference of two intervals that count as one, relative to them


class Entry(NamedTuple):
    """A file of a series: its number is the last one in its name; its time, where another file says it."""

    file: Path
    number: int | None
    time: float | None


@dataclass(frozen=True)
class Series:
    """Files of one simulation and one body.

    Attributes:
        folder: Where they lie.
        name: What their names share, with a star for the number; or the name of the single file.
        entries: The files in order.
    """

    folder: Path
    name: str
    entries: tuple[Entry, ...]

    def __str__(self) -> str:
        return str(self.folder / self.name)


@dataclass(frozen=True)
class FrameRef:
    """Where a frame is stored.

    Attributes:
        file: The file.
        index: Place of the frame in it, from 0.
        number: Number of the file, or None.
        time: Its time, as far as a file tells.
    """

    file: Path
    index: int
    number: int | None
    time: float | None


class Reader:
    """Reads frames; keeps what it read as long as there is plenty of memory, as an import looks at files several times.

    Args:
        progress: Wraps files to show progress, given a label.
    """

    def __init__(self, progress: Callable[[Iterable, str], Iterable] = lambda items, label: items):
        self.progress = progress
        self._room = memory_limit() // SHARE
        self._kept: dict[Path, list[Table]] = {}
        self._last: tuple[Path, list[Table]] | None = None

    def tables(self, file: Path) -> list[Table]:
        """All frames of a file."""
        if file in self._kept:
            return self._kept[file]
        if self._last is None or self._last[0] != file:
            self._last = file, read_tables(file)
            size = sum(values.nbytes for table in self._last[1] for values in table.arrays.values())
            if size <= self._room:
                self._room -= size
                self._kept[file] = self._last[1]
        return self._last[1]

    def table(self, ref: FrameRef) -> Table:
        """One frame."""
        return self.tables(ref.file)[ref.index]


def find_series(patterns: Sequence[str]) -> list[Series]:
    """Series of the files that patterns name: files, patterns with stars, .pvd collections and .series files.

    Raises:
        DataError: If a pattern matches nothing or a folder, or two files of a series have the same number.
    """
    series: list[Series] = []
    numbered: dict[tuple[Path, str], dict[Path, Entry]] = {}
    for file in [file for pattern in patterns for file in _matches(pattern)]:
        if file.suffix.lower() in (COLLECTION, SERIES):
            entries = read_collection(file) if file.suffix.lower() == COLLECTION else _read_series(file)
            series.append(Series(file.parent, file.name, tuple(Entry(path, None, time) for path, time in entries)))
            continue
        before, number, after = _numbered(file)
        name = file.name if number is None else f"{before}*{after}"
        numbered.setdefault((file.parent, name), {})[file] = Entry(file, number, None)
    series += [Series(folder, name, _ordered(list(entries.values()))) for (folder, name), entries in numbered.items()]
    return sorted(series, key=lambda each: _natural(str(each)))


def frames_of(series: Series, reader: Reader) -> list[list[FrameRef]]:
    """Frames of the runs of a series: all its files make one run, or each makes one where it holds several frames.

    Raises:
        DataError: If files with one frame and with several are mixed, or two frames have the same time.
    """
    counts = {}
    frames: list[list[FrameRef]] = []
    for entry in reader.progress(series.entries, "read files"):
        tables = reader.tables(entry.file)
        counts[entry.file] = len(tables)
        times = [table.time if entry.time is None else entry.time for table in tables]
        frames.append([FrameRef(entry.file, k, entry.number, time) for k, time in enumerate(times)])
    single = [file for file, count in counts.items() if count == 1]
    if single and len(single) < len(counts):
        several = next(file for file, count in counts.items() if count > 1)
        raise DataError(f"{single[0]}: holds one frame, but {several.name} several; import them one after the other.")
    runs = [[ref for refs in frames for ref in refs]] if single else frames
    for run in runs:
        _check_times(run)
    return runs


def interval(refs: Sequence[FrameRef], unit: float | None) -> tuple[list[float] | None, str | None]:
    """Times of frames, and what is irregular about them in words that name the first file after a gap; None if nothing.

    Args:
        refs: The frames in order.
        unit: Time of one step of the number in the file's name; None to take times from the files.
    """
    if unit is not None:
        times: list[float] | None = None if any(ref.number is None for ref in refs) else _scaled(refs, unit)
    else:
        times = None if any(ref.time is None for ref in refs) else [float(ref.time or 0) for ref in refs]
    values = times or [float(index if ref.number is None else ref.number) for index, ref in enumerate(refs)]
    steps = [later - earlier for earlier, later in zip(values[:-1], values[1:], strict=True)]
    usual = _most_common(steps)
    for ref, earlier, step in zip(refs[1:], values, steps, strict=False):
        if abs(step - usual) > IRREGULAR * usual:
            what = "time" if times else "number"
            line = f"{ref.file}: {what} {earlier + step:.6g} follows {earlier:.6g}, although most are {usual:.6g} apart"
            return times, line
    return times, None


def _most_common(steps: Sequence[float]) -> float:
    """The interval that most steps have to three digits, the shortest of several."""
    alike = Counter(f"{step:.3g}" for step in sorted(steps)).most_common(1)
    return float(alike[0][0]) if alike else 0.0


def _scaled(refs: Sequence[FrameRef], unit: float) -> list[float]:
    return [float(ref.number or 0) * unit for ref in refs]


def _check_times(run: Sequence[FrameRef]) -> None:
    for earlier, later in zip(run[:-1], run[1:], strict=True):
        if earlier.time is not None and later.time is not None and later.time <= earlier.time:
            what = "has the same time as" if later.time == earlier.time else "has an earlier time than"
            raise DataError(
                f"{later.file}: {what} {earlier.file.name} before it ({later.time:.6g}); drop one of them, or import "
                "simulations from folders of their own."
            )


def _matches(pattern: str) -> list[Path]:
    """Files that a pattern matches, in natural order."""
    path = Path(pattern)
    if path.is_dir():
        raise DataError(
            f"{path}: is a folder; name files, such as '{path}/*.vtu'. A folder in the LagrangeBench or "
            "DeepLagrangianFluids layout needs no import: cconv data inspect reads it."
        )
    found = [path] if path.is_file() else [Path(name) for name in glob.glob(pattern, recursive=True)]
    files = [file for file in found if file.is_file()]
    if not files:
        raise DataError(
            f"{one_line(pattern)}: no file matches; check the path, and quote patterns such as 'run/*.vtu'."
        )
    for file in files:
        if file.name.endswith(PACKED):
            raise DataError(
                f"{file}: is of the DeepLagrangianFluids layout, whose folders need no import: cconv data inspect "
                f"{file.parent} reads it."
            )
        if file.suffix.lower() not in (*READERS, COLLECTION, SERIES):
            known = ", ".join((*READERS, COLLECTION, ".vtu.series"))
            raise DataError(f"{file}: has an ending that is not read; known are {known}: convert it, or leave it out.")
    return sorted(files, key=lambda file: _natural(str(file)))


def _numbered(file: Path) -> tuple[str, int | None, str]:
    """The name of a file before its last number, this number or None, and the name after it."""
    match = re.fullmatch(r"(.*?)(\d+)(\D*)", file.stem)
    if match is None:
        return file.stem, None, file.suffix
    return match[1], int(match[2]), match[3] + file.suffix


def _ordered(entries: Sequence[Entry]) -> tuple[Entry, ...]:
    ordered = sorted(entries, key=lambda entry: entry.number or 0)
    for earlier, later in zip(ordered[:-1], ordered[1:], strict=True):
        if earlier.number == later.number:
            raise DataError(f"{later.file}: has the number of {earlier.file.name}; drop one of the two.")
    return tuple(ordered)


def _natural(text: str) -> list[tuple[int, str]]:
    """Key that sorts numbers in a text by value."""
    return [(int(part), "") if part.isdigit() else (-1, part) for part in re.split(r"(\d+)", text) if part]


def _read_series(file: Path) -> list[tuple[Path, float]]:
    """Files of a ParaView series (.vtu.series) with their times."""
    content = read_json(file)
    try:
        named = [(str(each["name"]), float(each["time"])) for each in content["files"]]
    except (KeyError, TypeError, ValueError) as error:
        raise DataError(
            f"{file}: must list files with name and time, as ParaView does; {json.dumps(str(error))}."
        ) from error
    for name, _ in named:
        if Path(name).is_absolute() or ".." in Path(name).parts or not (file.parent / name).is_file():
            raise DataError(
                f"{file}: names {one_line(name)!r}, which is not beside it; add it, or name files by a pattern."
            )
    return [(file.parent / name, time) for name, time in named]
