"""Simulations put together from series of files: frames of the fluid, of further phases and of walls side by side."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from cconv.data.importing.series import FrameRef, Reader, Series, find_series, frames_of
from cconv.errors import DataError

SAME_TIME = 1e-6  # difference of times that count as one, relative to the later of the two


@dataclass(frozen=True)
class Run:
    """The frames of one simulation.

    Attributes:
        name: Folder and names of the files of the fluid.
        fluid: Where each frame of each body lies: (frames, bodies).
        walls: The same of walls from files of their own; a wall with a single frame has it everywhere.
    """

    name: str
    fluid: tuple[tuple[FrameRef, ...], ...]
    walls: tuple[tuple[FrameRef, ...], ...]

    def __len__(self) -> int:
        return len(self.fluid)

    @property
    def times(self) -> tuple[FrameRef, ...]:
        """The frames of the first body, which tell the times."""
        return tuple(refs[0] for refs in self.fluid)

    @property
    def has_still_walls(self) -> bool:
        """Whether all frames have the same wall files."""
        return len({tuple((ref.file, ref.index) for ref in refs) for refs in self.walls}) == 1


def find_runs(patterns: Sequence[str], phases: Sequence[str], walls: Sequence[str], reader: Reader) -> list[Run]:
    """Simulations that patterns of files make: one for each folder, or for each file that holds several frames.

    Args:
        patterns: Files of the fluid.
        phases: Files of further fluids in the same simulations.
        walls: Files of walls: beside the fluid's, or a single series for all simulations.
        reader: Reads them.

    Raises:
        DataError: If a pattern matches nothing, files cannot be told apart, or a wall lacks a frame.
    """
    series = find_series(patterns)
    runs = [(each, refs) for each in series for refs in frames_of(each, reader)]
    _check_one_series_a_folder(runs)
    bodies = [(each, frames_of(each, reader)) for each in find_series(phases)]
    solids = [(each, frames_of(each, reader)) for each in find_series(walls)]
    return [
        Run(
            name=_name_of(each, refs),
            fluid=_side_by_side(refs, [refs, *_belonging(bodies, each, len(runs) == 1)]),
            walls=_side_by_side(refs, _belonging(solids, each, len(runs) == 1)),
        )
        for each, refs in runs
    ]


def _name_of(series: Series, refs: Sequence[FrameRef]) -> str:
    """The series of a run of many files, or the file of one that is a run by itself."""
    return str(refs[0].file) if len({ref.file for ref in refs}) == 1 else str(series)


def _check_one_series_a_folder(runs: Sequence[tuple[Series, Sequence[FrameRef]]]) -> None:
    """Several series of one frame a file in one folder may be bodies of a simulation, or several of these."""
    folders: dict[Path, Series] = {}
    for series, refs in runs:
        is_whole = refs[-1].index > 0
        earlier = folders.setdefault(series.folder, series)
        if earlier is not series and not is_whole:
            raise DataError(
                f"{series}: lies beside {earlier.name}; name one of them and give the other as --phase (fluid) or "
                "--boundary (walls), or put simulations into folders of their own. File names of a sequence differ "
                "in their last number alone."
            )


def _belonging(
    bodies: Sequence[tuple[Series, list[list[FrameRef]]]], series: Series, is_alone: bool
) -> list[list[FrameRef]]:
    """Frames of the bodies in the folder of a series, or of all where there is one run or they have a single frame."""
    found = []
    for body, runs in bodies:
        frames = [ref for refs in runs for ref in refs]
        if body.folder == series.folder or is_alone or len(frames) == 1:
            found.append(frames)
    return found


def _side_by_side(refs: Sequence[FrameRef], bodies: Sequence[Sequence[FrameRef]]) -> tuple[tuple[FrameRef, ...], ...]:
    return tuple(tuple(_same(ref, index, len(refs), body) for body in bodies) for index, ref in enumerate(refs))


def _same(ref: FrameRef, index: int, count: int, body: Sequence[FrameRef]) -> FrameRef:
    """The frame of a body at the time of another frame: by time, else by number, else by place."""
    if len(body) == 1:
        return body[0]
    for each in body:
        if ref.time is not None and each.time is not None:
            if abs(ref.time - each.time) <= SAME_TIME * max(abs(ref.time), abs(each.time)):
                return each
        elif ref.number is not None and ref.number == each.number:
            return each
    if ref.time is None and ref.number is None and len(body) == count:
        return body[index]
    raise DataError(
        f"{ref.file}: has no file of the same time or number beside {body[0].file.name}, {body[-1].file.name} ...; "
        "add it, or leave this frame out."
    )
