"""What a first reading of all frames finds: their numbers of particles, bounds, and whether they fit each other."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from cconv.data.importing.conversion import Conversion
from cconv.data.importing.fields import find_fields
from cconv.data.importing.particles import Particles, Types, joined, particles_of
from cconv.data.importing.runs import Run
from cconv.data.importing.series import FrameRef, Reader
from cconv.data.trajectory import ParticleType
from cconv.errors import DataError

SAME_SPACING = 1e-3  # relative difference of particle spacings of one simulation


@dataclass(frozen=True)
class FrameReader:
    """Reads frames of runs as particles.

    Attributes:
        reader: Reads files.
        mapping: Names of fields that the user gave.
        types: Meaning of types that the user gave, or None.
        fluid: Number of fluid particles at the beginning of each file, or None.
        conversion: Axes and units that particles are brought to.
    """

    reader: Reader
    mapping: Mapping[str, Sequence[str]]
    types: Types | None
    fluid: int | None
    conversion: Conversion

    def fluid_of(self, run: Run, k: int) -> Particles:
        """Particles of the fluid's files, those of walls among them included."""
        return joined([self._fluid(ref) for ref in run.fluid[k]])

    def walls_of(self, run: Run, k: int) -> Particles | None:
        """Particles of the walls' files, or None."""
        parts = [self._wall(ref) for ref in run.walls[k]]
        return joined(parts) if parts else None

    def fields(self, ref: FrameRef) -> dict[str, tuple[str, ...]]:
        """Names of the arrays that hold each field of the fluid."""
        return find_fields(self.reader.table(ref), self.mapping)

    def _fluid(self, ref: FrameRef) -> Particles:
        return self.conversion.of(particles_of(self.reader.table(ref), self.fields(ref), self.types, self.fluid))

    def _wall(self, ref: FrameRef) -> Particles:
        """Particles of a file that holds nothing but walls, whose names of fields may be the fluid's."""
        table = self.reader.table(ref)
        mapping = {field: names for field, names in self.mapping.items() if {*names} <= {*table.arrays}}
        return self.conversion.of(particles_of(table, find_fields(table, mapping | {"type": ()}), None, None))


@dataclass(frozen=True)
class Change:
    """What differs between two frames of a run.

    Attributes:
        file: File of the later one.
        text: What differs, in words.
    """

    file: Path
    text: str


@dataclass(frozen=True)
class RunScan:
    """What was found in a run.

    Attributes:
        first: Particles of its first frame.
        walls: Those of the walls' files in it, or None.
        counts: Numbers of particles of all frames.
        lower: Lower corner of all particles and walls, (C,).
        upper: Upper corner, (C,).
        change: The first change in number, ids or types of particles; None if there is none.
        walls_move: Whether walls from files of their own move.
    """

    first: Particles
    walls: Particles | None
    counts: tuple[int, ...]
    lower: np.ndarray
    upper: np.ndarray
    change: Change | None
    walls_move: bool


def scan_runs(runs: Sequence[Run], frames: FrameReader, progress: Callable[[Iterable, str], Iterable]) -> list[RunScan]:
    """Read every frame of all runs once; nothing of them is kept but the first.

    Raises:
        DataError: If a file is damaged, or frames differ in their dimensions, fields or particle spacing.
    """
    scans = [_scan(run, frames, progress) for run in runs]
    for scan in scans[1:]:
        _check_alike(scan.first, scans[0].first)
    return scans


def _scan(run: Run, frames: FrameReader, progress: Callable[[Iterable, str], Iterable]) -> RunScan:
    first, walls = frames.fluid_of(run, 0), frames.walls_of(run, 0)
    counts, lower, upper = [], [], []
    change, walls_move = None, False
    for k in progress(range(len(run)), "read frames"):
        particles, solids = frames.fluid_of(run, k), frames.walls_of(run, k)
        _check_alike(particles, first)
        if solids is not None and walls is not None:
            _check_dimensions(solids, first)
            walls_move = walls_move or not np.array_equal(solids.positions, walls.positions)
            change = change or _change(walls, solids)
        change = change or _change(first, particles)
        points = [each.positions for each in (particles, solids) if each is not None]
        counts.append(len(particles))
        lower.append(np.min([each.min(axis=0) for each in points], axis=0))
        upper.append(np.max([each.max(axis=0) for each in points], axis=0))
    return RunScan(first, walls, tuple(counts), np.min(lower, axis=0), np.max(upper, axis=0), change, walls_move)


def _change(first: Particles, later: Particles) -> Change | None:
    if len(later) != len(first):
        text = f"has {len(later)} particles, {first.file.name} has {len(first)}: particles enter or leave"
    elif first.ids is not None and later.ids is not None and not np.array_equal(first.ids, later.ids):
        text = f"has other particles than {first.file.name}, by their ids: particles enter and leave"
    elif not np.array_equal(first.types, later.types):
        text = f"has other particle types than {first.file.name}"
    else:
        return None
    return Change(later.file, text)


def _check_alike(later: Particles, first: Particles) -> None:
    _check_dimensions(later, first)
    for name in ("velocity", "mass", "density"):
        if (name in later.values) != (name in first.values):
            has, lacks = (later, first) if name in later.values else (first, later)
            raise DataError(
                f"{lacks.file}: has no {name}, {has.file.name} has; write it again, or leave it out with --map {name}="
            )
    spacings = [float(np.median(each.values["spacing"])) for each in (first, later) if "spacing" in each.values]
    if len(spacings) == 2 and abs(spacings[1] - spacings[0]) > SAME_SPACING * spacings[0]:
        raise DataError(
            f"{later.file}: has the particle spacing {spacings[1]:g}, {first.file.name} has {spacings[0]:g}; it is of "
            "another simulation: leave it out."
        )


def _check_dimensions(later: Particles, first: Particles) -> None:
    if later.positions.shape[1] != first.positions.shape[1]:
        raise DataError(
            f"{later.file}: has {later.positions.shape[1]} dimensions, {first.file.name} has "
            f"{first.positions.shape[1]}; write both with as many."
        )


def count_of(types: np.ndarray, kind: ParticleType) -> int:
    """Number of particles of a kind."""
    return int((types == kind).sum())
