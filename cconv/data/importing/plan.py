"""The import of particle files: first a plan that says what was found and taken for what, then the data set."""

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

from cconv.data.arrays import ParticleArrays, SceneFacts, write_runs
from cconv.data.importing.particles import Particles, Types
from cconv.data.importing.runs import Run, find_runs
from cconv.data.importing.scan import FrameReader, RunScan, count_of, scan_runs
from cconv.data.importing.series import IRREGULAR, Reader, interval
from cconv.data.limits import memory_limit, one_line
from cconv.data.source import STORED
from cconv.data.trajectory import ParticleType
from cconv.domain import Box
from cconv.errors import ConfigError, DataError

AXES = "xyz"
SEVERAL_PHASES = 1.2  # ratio of densities in the first frame beyond which particles have masses of their own
SINGLY = "import frames singly with --separate-frames, for tasks that ask for fields of the present frame"
Progress = Callable[[Iterable, str], Iterable]


@dataclass(frozen=True, kw_only=True)
class ImportSettings:
    """What a user says about the files; None and empty where they are to tell.

    Attributes:
        mapping: Names of the arrays of fields.
        types: Meaning of the values of particle types.
        fluid: Number of fluid particles at the beginning of each file; moving walls follow.
        dt: Time between frames.
        name_time: Time of one step of the number in file names.
        particle_spacing: Distance of neighbouring particles at rest.
        mass: Mass of every particle.
        force: Constant external acceleration.
        bounds: Lower and upper bound of each axis.
        periodic: Letters of the periodic axes.
        separate_frames: Whether each frame becomes a trajectory of its own.
        split_fractions: Shares of train, valid and test.
        gap: Frames dropped between the splits of a single run.
        data_seed: Seed of the permutation of runs.
    """

    mapping: dict[str, tuple[str, ...]] = field(default_factory=dict)
    types: Types | None = None
    fluid: int | None = None
    dt: float | None = None
    name_time: float | None = None
    particle_spacing: float | None = None
    mass: float | None = None
    force: tuple[float, ...] | None = None
    bounds: tuple[tuple[float, float], ...] | None = None
    periodic: str = ""
    separate_frames: bool = False
    split_fractions: tuple[float, ...] = (0.7, 0.15, 0.15)
    gap: int = 2
    data_seed: int = 0


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
    """

    found: dict[str, str]
    missing: tuple[str, ...]
    trajectories: Sequence[ParticleArrays]
    runs: tuple[str, ...]
    scene: SceneFacts
    settings: ImportSettings

    def write(self, folder: Path, overwrite: bool, progress: Progress) -> None:
        """Write the data set; errors as of `cconv.data.arrays.write_dataset`."""
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
    reader = Reader()
    runs = find_runs(patterns, phases, walls, reader)
    frames = FrameReader(reader, settings.mapping, settings.types, settings.fluid)
    scans = scan_runs(runs, frames, progress)
    axes = _axes(scans)
    spacing, spacing_from = _spacing(scans[0].first, axes, settings)
    frame_dt, dt_from = _frame_dt(runs, scans, settings)
    masses = _Masses.of(scans[0].first, settings.mass, spacing ** len(axes))
    walls_move = any(scan.walls_move for scan in scans)
    trajectories = ImportedTrajectories(runs, frames, axes, masses, settings.separate_frames, walls_move)
    if settings.separate_frames:
        _check_velocities(scans[0].first)
    missing = _missing(scans[0], settings, spacing_from, dt_from, masses, walls_move)
    scene = SceneFacts(
        particle_spacing=spacing,
        frame_dt=frame_dt,
        box=_box(scans, axes, spacing, settings),
        force=_of_axes(settings.force, axes, "--force"),
        missing=missing,
        mass_source=masses.source,
    )
    found = _found(runs, scans, frames, axes) | {
        "particle spacing": f"{spacing:g} ({spacing_from})",
        "time between frames": f"{frame_dt:.6g} ({dt_from})",
        "box": _box_text(scene.box, settings),
        "masses": masses.source,
        "written as": trajectories.description,
    }
    return ImportPlan(found, missing, trajectories, trajectories.runs, scene, settings)


class ImportedTrajectories(Sequence[ParticleArrays]):
    """Trajectories of runs: one a run, or one a frame; the last one that was read is kept.

    Args:
        runs: The runs.
        frames: Reads their frames.
        axes: Axes that are kept.
        masses: Masses of particles.
        separate: Whether each frame is a trajectory.
        walls_move: Whether walls from files of their own move.
    """

    def __init__(
        self,
        runs: Sequence[Run],
        frames: FrameReader,
        axes: Sequence[int],
        masses: "_Masses",
        separate: bool,
        walls_move: bool,
    ):
        self._frames, self._axes, self._masses, self._walls_move = frames, list(axes), masses, walls_move
        whole = [(run, range(len(run))) for run in runs]
        single = [(run, range(k, k + 1)) for run in runs for k in range(len(run))]
        self._parts = single if separate else whole
        self._separate = separate
        self._last: tuple[int, ParticleArrays] | None = None

    @property
    def runs(self) -> tuple[str, ...]:
        """Name of the run of each trajectory."""
        return tuple(run.name for run, _ in self._parts)

    @property
    def description(self) -> str:
        """What becomes of the runs, in words."""
        if self._separate:
            return f"{len(self._parts)} trajectories of one frame each: for fields, not for steps"
        return f"{len(self._parts)} " + ("trajectory" if len(self._parts) == 1 else "trajectories")

    def __len__(self) -> int:
        return len(self._parts)

    def __getitem__(self, index):
        if self._last is None or self._last[0] != index:
            self._last = index, self._read(*self._parts[index])
        return self._last[1]

    def __iter__(self) -> Iterator[ParticleArrays]:
        return (self[index] for index in range(len(self)))

    def _read(self, run: Run, chosen: range) -> ParticleArrays:
        first = self._frames.fluid_of(run, chosen[0])
        walls = self._frames.walls_of(run, chosen[0])
        joins_walls = walls is not None and self._walls_move and not self._separate
        _check_memory(first, len(chosen), run)
        frames = [self._frames.fluid_of(run, k) for k in chosen]
        moving = [self._frames.walls_of(run, k) for k in chosen] if joins_walls else []
        solids = [each for each in moving if each is not None]
        normals = None if walls is None or joins_walls else walls.values.get("normal")
        viscosities = first.values.get("viscosity")
        added = len(solids[0]) if solids else 0
        return ParticleArrays(
            positions=_stacked([each.positions for each in frames], [each.positions for each in solids], self._axes),
            velocities=self._velocities(frames, solids),
            masses=self._masses.values(first, added),
            particle_types=np.append(first.types, np.full(added, int(ParticleType.MOVING_WALL))),
            viscosities=None if viscosities is None or added else viscosities,
            boundary_positions=None if walls is None or joins_walls else walls.positions[:, self._axes],
            boundary_normals=None if normals is None else _unit(self._vectors(normals, walls)),
        )

    def _velocities(self, frames: Sequence[Particles], solids: Sequence[Particles]) -> np.ndarray | None:
        if any("velocity" not in each.values for each in (*frames, *solids)):
            return None
        return np.stack(
            [
                np.concatenate([self._vectors(each.values["velocity"], each) for each in parts])
                for parts in (zip(frames, solids, strict=True) if solids else zip(frames, strict=True))
            ]
        )

    def _vectors(self, values: np.ndarray, of: Particles | None) -> np.ndarray:
        """Components of vectors (N, C) on the axes that are kept."""
        if values.shape[1] == len(self._axes):
            return values
        if of is not None and values.shape[1] != of.positions.shape[1]:
            raise DataError(
                f"{of.file}: vectors have {values.shape[1]} components, positions {of.positions.shape[1]}; write "
                "both with as many."
            )
        return values[:, self._axes]


@dataclass(frozen=True)
class _Masses:
    """Masses of particles: given, stored, from densities, or none.

    Attributes:
        source: Where they come from, in words.
        mass: One for all, or None.
        field: Field that holds them, or None.
        factor: What values of the field are multiplied by.
    """

    source: str
    mass: float | None
    field: str | None
    factor: float

    @classmethod
    def of(cls, first: Particles, given: float | None, volume: float) -> "_Masses":
        """Decide by the first frame; `volume` is that of a particle at rest."""
        if given is not None:
            return cls(f"given: {given:g}", given, None, 1.0)
        if "mass" in first.values and (first.values["mass"] > 0).all():
            return cls(STORED, None, "mass", 1.0)
        if "density" in first.values and (first.values["density"] > 0).all():
            densities = first.values["density"][first.types == ParticleType.FLUID].astype(np.float64)
            low, middle, high = np.quantile(densities, (0.02, 0.5, 0.98))
            if high > SEVERAL_PHASES * low:
                return cls("density of each particle in the first frame times its volume", None, "density", volume)
            return cls(f"median density {middle:.6g} of the first frame times the volume", middle * volume, None, 1.0)
        return cls("none: rest density 1 times the volume", None, None, volume)

    def values(self, particles: Particles, added: int) -> np.ndarray | None:
        """Masses (N,) of the particles, and of `added` wall particles, as heavy as most; None if there are none."""
        if self.mass is not None:
            return np.full(len(particles) + added, self.mass)
        if self.field is None:
            return None
        masses = particles.values[self.field] * self.factor
        return np.append(masses, np.full(added, np.median(masses))).astype(masses.dtype)


def _axes(scans: Sequence[RunScan]) -> list[int]:
    """Axes along which particles differ in any frame; data of two dimensions are often stored with a third."""
    lower, upper = np.min([scan.lower for scan in scans], axis=0), np.max([scan.upper for scan in scans], axis=0)
    axes = np.flatnonzero(upper > lower).tolist()
    if not axes:
        raise DataError(f"{scans[0].first.file}: all particles are at one place in all frames; map the positions.")
    return axes


def _spacing(first: Particles, axes: Sequence[int], settings: ImportSettings) -> tuple[float, str]:
    if settings.particle_spacing is not None:
        return settings.particle_spacing, "given"
    if "spacing" in first.values:
        return float(f"{np.median(first.values['spacing']):.6g}"), "stored"
    points = first.positions[:, axes][first.types == ParticleType.FLUID].astype(np.float64)
    if len(points) < 2:
        raise ConfigError("`--particle-spacing` must be given, as a single particle does not tell it.")
    spacing = float(f"{np.median(cKDTree(points).query(points, k=2)[0][:, 1]):.3g}")
    if spacing <= 0:
        raise DataError(f"{first.file}: half of the particles lie at the place of another; drop copies.")
    return spacing, "estimated: half of the particles of the first frame have their nearest neighbour within"


def _frame_dt(runs: Sequence[Run], scans: Sequence[RunScan], settings: ImportSettings) -> tuple[float, str]:
    """Time between frames and where it comes from.

    Raises:
        DataError: If frames do not follow each other at one interval with the same particles, unless they are separate.
        ConfigError: If nothing tells the time.
    """
    intervals: list[float] = []
    for run, scan in zip(runs, scans, strict=True):
        refs = run.times if settings.dt is None else [replace(ref, time=None) for ref in run.times]
        times, gap = interval(refs, settings.name_time)
        if not settings.separate_frames:
            if gap is not None:
                raise DataError(f"{gap}; add the missing files, name fewer, or {SINGLY}.")
            if scan.change is not None:
                raise DataError(f"{scan.change.file}: {scan.change.text}; {SINGLY}.")
        if times is not None and len(times) > 1:
            intervals.append(float(np.median(np.diff(times))))
    if settings.dt is not None:
        return settings.dt, "given"
    if intervals and intervals[0] > 0:
        if max(intervals) - min(intervals) > IRREGULAR * max(intervals) and not settings.separate_frames:
            raise DataError(
                f"{runs[0].name}: frames are {intervals[0]:.6g} apart, those of another run up to {max(intervals):.6g}; "
                "import runs of one interval."
            )
        return float(
            f"{np.median(intervals):.9g}"
        ), "numbers in file names" if settings.name_time else "times in the files"
    if settings.separate_frames:
        return 1.0, "not known; 1 stands for it, as single frames do not need it"
    raise ConfigError(
        "`--dt` must be given, as the files hold no times: the time between frames, or --name-time UNIT if the number "
        "in file names counts units of time."
    )


def _check_velocities(first: Particles) -> None:
    if "velocity" not in first.values:
        raise DataError(
            f"{first.file}: has no velocities, and single frames do not tell them; say what they are with --map "
            "velocity=NAME, or import frames at one interval without --separate-frames."
        )


def _box(scans: Sequence[RunScan], axes: Sequence[int], spacing: float, settings: ImportSettings) -> Box:
    letters = [letter for letter in settings.periodic.replace(",", "").replace(" ", "")]
    unknown = [letter for letter in letters if letter not in [AXES[axis] for axis in axes]]
    if unknown:
        kept = ", ".join(AXES[axis] for axis in axes)
        raise ConfigError(f"`--periodic` must name axes of the data ({kept}), got {settings.periodic!r}.")
    if letters and settings.bounds is None:
        raise ConfigError("`--bounds` must be given with --periodic, as particles do not tell where the box ends.")
    bounds = _of_axes(settings.bounds, axes, "--bounds")
    if bounds is None:
        lower = np.min([scan.lower for scan in scans], axis=0).astype(np.float64)[list(axes)] - spacing / 2
        upper = np.max([scan.upper for scan in scans], axis=0).astype(np.float64)[list(axes)] + spacing / 2
        return Box(lower.tolist(), upper.tolist())
    return Box([low for low, _ in bounds], [high for _, high in bounds], [AXES[axis] in letters for axis in axes])


def _of_axes(values: tuple | None, axes: Sequence[int], option: str) -> tuple | None:
    """Values of the axes that are kept, of values for these or for all that the files have."""
    if values is None or len(values) == len(axes):
        return values
    if len(values) <= max(axes):
        raise ConfigError(f"`{option}` must have a value for each of the {len(axes)} axes, got {len(values)}.")
    return tuple(values[axis] for axis in axes)


def _missing(
    scan: RunScan, settings: ImportSettings, spacing_from: str, dt_from: str, masses: _Masses, walls_move: bool
) -> tuple[str, ...]:
    """What the files lack beside what every data set of arrays says, a line each."""
    moving = count_of(scan.first.types, ParticleType.MOVING_WALL) or walls_move
    lines = {
        "particle spacing": None
        if spacing_from in ("given", "stored")
        else "not stored; " + spacing_from.partition(":")[0],
        "frame dt": "not stored; 1 stands for it" if dt_from.startswith("not known") else None,
        "particle ids": None
        if scan.first.ids is not None or settings.separate_frames
        else "not stored; particles are taken to keep their order",
        "masses": None if masses.source == STORED or masses.mass is None or settings.mass else masses.source,
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


def _stacked(frames: Sequence[np.ndarray], solids: Sequence[np.ndarray], axes: list[int]) -> np.ndarray:
    """Positions (T, N, D) of frames, with the wall particles of each after them."""
    if solids:
        frames = [np.concatenate(parts) for parts in zip(frames, solids, strict=True)]
    return np.stack(frames)[..., axes]


def _unit(normals: np.ndarray) -> np.ndarray:
    lengths = np.linalg.norm(normals, axis=1, keepdims=True)
    return normals / np.where(lengths > 0, lengths, 1)


def _check_memory(first: Particles, frames: int, run: Run) -> None:
    size = 4 * frames * first.positions.nbytes  # positions and velocities, twice while they are put together
    if size > memory_limit():
        raise DataError(
            f"{run.name}: takes {size / 1e9:.3g} GB, more than half of the free memory; import fewer frames."
        )
