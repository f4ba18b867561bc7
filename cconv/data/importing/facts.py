"""Facts of a scene that files tell or leave open: dimensions, particle spacing, time between frames, box."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.spatial import cKDTree

from cconv.data.importing.conversion import AXES
from cconv.data.importing.particles import Particles
from cconv.data.importing.runs import Run
from cconv.data.importing.scan import RunScan
from cconv.data.importing.series import IRREGULAR, interval
from cconv.data.importing.settings import ImportSettings
from cconv.data.trajectory import ParticleType
from cconv.domain import Box
from cconv.errors import ConfigError, DataError

GIVEN, IN_FILES = "given", "stored"  # where a value comes from
SINGLY = "import frames singly with --separate-frames, for tasks that ask for fields of the present frame"


def axes_of(scans: Sequence[RunScan]) -> list[int]:
    """Axes along which particles differ in any frame; data of two dimensions are often stored with a third.

    Raises:
        DataError: If there are none.
    """
    lower, upper = np.min([scan.lower for scan in scans], axis=0), np.max([scan.upper for scan in scans], axis=0)
    axes = np.flatnonzero(upper > lower).tolist()
    if not axes:
        raise DataError(f"{scans[0].first.file}: all particles are at one place in all frames; map the positions.")
    return axes


def spacing_of(first: Particles, axes: Sequence[int], settings: ImportSettings) -> tuple[float, str]:
    """Particle spacing and where it comes from: given, stored, or the median distance of nearest neighbours.

    Args:
        first: Particles of the first frame.
        axes: Axes that are kept.
        settings: What the user says.

    Raises:
        ConfigError: If a single particle does not tell it.
        DataError: If particles lie at the place of others.
    """
    if settings.particle_spacing is not None:
        return settings.particle_spacing, GIVEN
    if "spacing" in first.values:
        return float(f"{np.median(first.values['spacing']):.6g}"), IN_FILES
    points = first.positions[:, axes][first.types == ParticleType.FLUID].astype(np.float64)
    if len(points) < 2:
        raise ConfigError("`--particle-spacing` must be given, as a single particle does not tell it.")
    spacing = float(f"{np.median(cKDTree(points).query(points, k=2)[0][:, 1]):.3g}")
    if spacing <= 0:
        raise DataError(f"{first.file}: half of the particles lie at the place of another; drop copies.")
    return spacing, "estimated: half of the particles of the first frame have their nearest neighbour within"


def frame_dt_of(runs: Sequence[Run], scans: Sequence[RunScan], settings: ImportSettings) -> tuple[float, str]:
    """Time between frames and where it comes from.

    Raises:
        DataError: If frames do not follow each other at one interval with the same particles, unless they are separate.
        ConfigError: If nothing tells the time.
    """
    intervals: list[float] = []
    is_irregular = False
    for run, scan in zip(runs, scans, strict=True):
        refs = run.times if settings.dt is None else [replace(ref, time=None) for ref in run.times]
        times, gap = interval(refs, settings.name_time)
        is_irregular = is_irregular or gap is not None
        if not settings.separate_frames:
            if gap is not None:
                raise DataError(f"{gap}; add the missing files, name fewer, or {SINGLY}.")
            if scan.change is not None:
                raise DataError(f"{scan.change.file}: {scan.change.text}; {SINGLY}.")
        if times is not None and len(times) > 1:
            unit = 1.0 if settings.name_time else settings.conversion.time
            intervals.append(float(np.median(np.diff(times))) * unit)
    if settings.dt is not None:
        return settings.dt, GIVEN
    if intervals and intervals[0] > 0:
        if max(intervals) - min(intervals) > IRREGULAR * max(intervals) and not settings.separate_frames:
            raise DataError(
                f"{runs[0].name}: frames are {intervals[0]:.6g} apart, those of another run {max(intervals):.6g}; "
                "import runs of one interval."
            )
        source = "numbers in file names" if settings.name_time else "times in the files"
        return float(f"{np.median(intervals):.9g}"), source + (", irregular: the median" if is_irregular else "")
    if settings.separate_frames:
        return 1.0, "not known; 1 stands for it, as single frames do not need it"
    raise ConfigError(
        "`--dt` must be given, as the files hold no times: the time between frames, or --name-time UNIT if the number "
        "in file names counts units of time."
    )


def box_of(scans: Sequence[RunScan], axes: Sequence[int], spacing: float, settings: ImportSettings) -> Box:
    """The box that is given, or an open one around all particles and walls, half a spacing wider.

    Args:
        scans: What was found in the runs.
        axes: Axes that are kept.
        spacing: Particle spacing.
        settings: What the user says.

    Raises:
        ConfigError: If a periodic axis is not one of the data, or has no bounds.
    """
    letters = settings.periodic.replace(",", "").replace(" ", "")
    unknown = [letter for letter in letters if letter not in [AXES[axis] for axis in axes]]
    if unknown:
        kept = ", ".join(AXES[axis] for axis in axes)
        raise ConfigError(f"`--periodic` must name axes of the data ({kept}), got {settings.periodic!r}.")
    if letters and settings.bounds is None:
        raise ConfigError("`--bounds` must be given with --periodic, as particles do not tell where the box ends.")
    bounds = on_axes(settings.bounds, axes, "--bounds")
    if bounds is None:
        lower = np.min([scan.lower for scan in scans], axis=0).astype(np.float64)[list(axes)] - spacing / 2
        upper = np.max([scan.upper for scan in scans], axis=0).astype(np.float64)[list(axes)] + spacing / 2
        return Box(lower.tolist(), upper.tolist())
    return Box([low for low, _ in bounds], [high for _, high in bounds], [AXES[axis] in letters for axis in axes])


def on_axes(values: tuple | None, axes: Sequence[int], option: str) -> tuple | None:
    """Values of the axes that are kept, of values for these or for all that the files have.

    Raises:
        ConfigError: If there are too few of them.
    """
    if values is None or len(values) == len(axes):
        return values
    if len(values) <= max(axes):
        raise ConfigError(f"`{option}` must have a value for each of the {len(axes)} axes, got {len(values)}.")
    return tuple(values[axis] for axis in axes)
