"""The import of particle files: first a plan that says what was found and taken for what, then the data set."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

from cconv.data.arrays import ParticleArrays, SceneFacts, split_runs, write_runs
from cconv.data.folders import check_room
from cconv.data.hdf5 import LEAST_COMPRESSED
from cconv.data.importing.conversion import AXES
from cconv.data.importing.facts import GIVEN, IN_FILES, axes_of, box_of, frame_dt_of, on_axes, spacing_of
from cconv.data.importing.masses import Masses
from cconv.data.importing.runs import Run, find_runs
from cconv.data.importing.scan import FrameReader, RunScan, count_of, scan_runs
from cconv.data.importing.series import Reader
from cconv.data.importing.settings import ImportSettings
from cconv.data.importing.trajectories import ImportedTrajectories, components_on
from cconv.data.limits import one_line
from cconv.data.source import STORED
from cconv.data.trajectory import ParticleType
from cconv.domain import Box
from cconv.errors import DataError

Progress = Callable[[Iterable, str], Iterable]


@dataclass(frozen=True)
class ImportPlan:
    """What an import will write.

    Attributes:
        found: What was found and taken for what, by topic.
        missing: What was not found, with what stands for it.
        trajectories: The trajectories, read when they are asked for.
        runs: Name of the run of each trajectory.
        scene: What they share.
        settings: What the user said.
        least_bytes: Bytes that the data set takes at least.
    """

    found: dict[str, str]
    missing: tuple[str, ...]
    trajectories: Sequence[ParticleArrays]
    runs: tuple[str, ...]
    scene: SceneFacts
    settings: ImportSettings
    least_bytes: int

    def write(self, folder: Path, overwrite: bool, progress: Progress) -> None:
        """Write the data set; errors as of `cconv.data.arrays.write_dataset`, and `ConfigError` on too small a disk."""
        check_room(folder, self.least_bytes)
        split = (self.settings.split_fractions, self.settings.gap, self.settings.data_seed)
        write_runs(folder, self.trajectories, self.scene, self.runs, split, overwrite, progress)


def plan_import(
    patterns: Sequence[str],
    settings: ImportSettings,
    *,
    phases: Sequence[str] = (),
    walls: Sequence[str] = (),
    progress: Progress = lambda items, label: items,
) -> ImportPlan:
    """Read all files once and decide what they are; nothing is written.

    Args:
        patterns: Files of the fluid, or patterns with stars.
        settings: What the user says about them.
        phases: Files of further fluids.
        walls: Files of walls.
        progress: Wraps frames to show progress, given a label.

    Raises:
        DataError: If files are missing, damaged, or do not fit each other.
        ConfigError: If something must be given that the files do not tell.
    """
    reader = Reader(progress)
    runs = find_runs(patterns, phases, walls, reader)
    _check_enough(runs, settings)
    frames = FrameReader(reader, settings.mapping, settings.types, settings.fluid, settings.conversion)
    scans = scan_runs(runs, frames, progress)
    axes = axes_of(scans)
    spacing, spacing_from = spacing_of(scans[0].first, axes, settings)
    frame_dt, dt_from = frame_dt_of(runs, scans, settings)
    in_files = settings.conversion  # densities are in the units of the files
    volume = in_files.mass * (spacing / in_files.length) ** len(axes)
    masses = Masses.of(scans[0].first, settings.mass, volume)
    walls_move = any(scan.walls_move for scan in scans)
    trajectories = ImportedTrajectories(runs, frames, axes, masses, settings.separate_frames, walls_move, frame_dt)
    _check_vectors(scans, axes, settings)
    missing = _missing(scans[0], settings, spacing_from, dt_from, masses, walls_move)
    scene = SceneFacts(
        particle_spacing=spacing,
        frame_dt=frame_dt,
        box=box_of(scans, axes, spacing, settings),
        force=on_axes(settings.force, axes, "--force"),
        missing=missing,
        mass_source=masses.source,
    )
    found = _found(runs, scans, frames, axes) | {
        "particle spacing": f"{spacing:g} ({spacing_from})",
        "time between frames": f"{frame_dt:.6g} ({dt_from})",
        "box": _box_text(scene.box, settings),
        "masses": masses.source,
        "converted": settings.conversion.text or "nothing: units and axes are those of the files",
        "written as": trajectories.description,
    }
    positions = 4 * len(axes) * sum(sum(scan.counts) for scan in scans)  # bytes, uncompressed
    return ImportPlan(
        found, missing, trajectories, trajectories.runs, scene, settings, int(LEAST_COMPRESSED * positions)
    )


def _check_enough(runs: Sequence[Run], settings: ImportSettings) -> None:
    """Check that the runs can be split, before all of their files are read."""
    split = (settings.split_fractions, settings.gap, settings.data_seed)
    split_runs([run.name for run in runs], lambda k: len(runs[k]), split, runs[0].times[0].file.parent)


def _check_vectors(scans: Sequence[RunScan], axes: list[int], settings: ImportSettings) -> None:
    """Check that vectors have the components of positions, and that there are velocities where frames are separate."""
    for particles in (each for scan in scans for each in (scan.first, scan.walls) if each is not None):
        for name in ("velocity", "normal"):
            if name in particles.values:
                components_on(axes, particles.values[name], particles)
    first = scans[0].first
    if settings.separate_frames and "velocity" not in first.values:
        raise DataError(
            f"{first.file}: has no velocities, and single frames do not tell them; say what they are with --map "
            "velocity=NAME, or import frames at one interval without --separate-frames."
        )


def _missing(
    scan: RunScan, settings: ImportSettings, spacing_from: str, dt_from: str, masses: Masses, walls_move: bool
) -> tuple[str, ...]:
    """What the files lack beside what every data set of arrays says, a line each."""
    moving = count_of(scan.first.types, ParticleType.MOVING_WALL) or walls_move
    lines = {
        "particle spacing": None
        if spacing_from in (GIVEN, IN_FILES)
        else "not stored; " + spacing_from.partition(":")[0],
        "frame dt": "not stored; 1 stands for it" if dt_from.startswith("not known") else None,
        "particle ids": None
        if scan.first.ids is not None or settings.separate_frames
        else "not stored; particles are taken to keep their order",
        "masses": None
        if masses.source == STORED or settings.mass or masses.is_nothing
        else f"not stored; {masses.source}",
        "steps": "frames are single: no task of steps" if settings.separate_frames else None,
        "moving walls": "at their first place in tasks of fields, unless imported with --separate-frames"
        if moving and not settings.separate_frames
        else None,
        "boundary": "no walls found; name their files with --boundary, or their types with --types"
        if scan.walls is None and (scan.first.types == ParticleType.FLUID).all()
        else None,
    }
    return tuple(f"{topic}: {line}" for topic, line in lines.items() if line)


def _found(runs: Sequence[Run], scans: Sequence[RunScan], frames: FrameReader, axes: Sequence[int]) -> dict[str, str]:
    first, table = scans[0].first, frames.reader.table(runs[0].times[0])
    fields = frames.fields(runs[0].times[0])
    used = {name for names in fields.values() for name in names}
    counts = [count for scan in scans for count in scan.counts]
    dropped = [axis for axis in range(first.positions.shape[1]) if axis not in axes]
    rest = f"; {', '.join(AXES[axis] for axis in dropped)} never differs and is dropped" if dropped else ""
    kinds = {kind.name.lower().replace("_", " "): count_of(first.types, kind) for kind in ParticleType}
    solids = scans[0].walls
    moves = "moving" if any(scan.walls_move for scan in scans) else "still"
    return {
        "runs": ", ".join(f"{one_line(run.name, 80)} ({len(run)} frames)" for run in runs[:5])
        + (f" and {len(runs) - 5} more" if len(runs) > 5 else ""),
        "particles": f"{min(counts)} to {max(counts)}" if min(counts) < max(counts) else str(counts[0]),
        "types": ", ".join(f"{count} {kind}" for kind, count in kinds.items() if count),
        "dimensions": f"{len(axes)} ({', '.join(AXES[axis] for axis in axes)}{rest})",
        **{field: one_line(" + ".join(f"`{name}`" for name in names)) for field, names in fields.items()},
        "not used": one_line(", ".join(name for name in table.arrays if name not in used)) or "nothing",
        "boundary": "no files"
        if solids is None
        else f"{len(solids)} points, {moves}" + (", with normals" if "normal" in solids.values else ""),
    }


def _box_text(box: Box | None, settings: ImportSettings) -> str:
    if box is None:
        return "none"
    axes = ", ".join(f"{low:.6g} to {high:.6g}" for low, high in zip(box.lower, box.upper, strict=True))
    return f"{axes} ({'given' if settings.bounds else 'around all particles, half a spacing wider'})"
