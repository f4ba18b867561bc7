"""Pictures of particles: frames side by side, and animations.

Particles are as large as the fluid that each stands for: discs of area dx^2, in three dimensions balls of volume dx^3.
Walls are grey in the plane, unless the colour shows the type, and hardly seen in space.
"""

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import seaborn as sns
from matplotlib.animation import AbstractMovieWriter, FFMpegWriter, PillowWriter
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.collections import EllipseCollection
from matplotlib.colors import Normalize, to_rgba, to_rgba_array
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from mpl_toolkits.mplot3d import Axes3D
from mpl_toolkits.mplot3d.proj3d import proj_transform

from cconv.data.folders import whole_file
from cconv.data.quantities import density_deviation, speed
from cconv.data.trajectory import Frame, Frames, ParticleType, Scene, check_frames, time_of
from cconv.errors import ConfigError, check_choice
from cconv.forces import ConstantForce, Force

Progress = Callable[[Iterable, str], Iterable]

PICTURE_DPI, ANIMATION_DPI, SIDE_BY_SIDE_DPI = 130, 90, 60
FRAMES_PER_SECOND = 20
_TYPE_COLORS = {
    ParticleType.PAD: "#e6e6e6",
    ParticleType.FLUID: "#4c72b0",
    ParticleType.SOLID_WALL: "#8c8c8c",
    ParticleType.MOVING_WALL: "#dd8452",
    ParticleType.RIGID: "#55a868",
}
_RGBA = tuple[float, float, float, float]
_WALL_COLOR, _BOUNDARY_COLOR = "#b3b3b3", "#cccccc"


def frames_chart(
    trajectory: Frames,
    scene: Scene,
    frames: Sequence[int],
    color: str = "speed",
    progress: Progress = lambda items, label: items,
) -> Figure:
    """Frames of a trajectory side by side, with one key to the colours of all.

    Args:
        trajectory: What to draw.
        scene: Scene of the trajectory, 2D or 3D.
        frames: Indices of frames within the trajectory.
        color: "speed", "density" (deviation from rest, see `density_deviation`) or "type".
        progress: Wraps the frames to show progress, given a label.

    Raises:
        ConfigError: If a frame is out of range, the colour unknown or the scene 1D.
    """
    coloring = _coloring(color, trajectory, scene, frames, progress)
    stage = _stage(scene)
    figure, panels = _set_up(stage, coloring, trajectory, _title(trajectory, scene), len(frames))
    for axes, k in zip(panels, frames, strict=True):
        _draw_frame(axes, stage, coloring, trajectory, scene, k)
    return figure


def write_picture(figure: Figure, file: str | Path) -> None:
    """Write a figure as PNG; the file appears when all is written.

    Raises:
        ConfigError: If the name does not end in .png, or the file cannot be written.
    """
    check_picture_name(file)
    with whole_file(Path(file)) as partial:
        figure.savefig(partial, format="png", dpi=PICTURE_DPI)


def write_animation(
    file: str | Path,
    trajectory: Frames | Mapping[str, Frames],
    scene: Scene,
    frames: Sequence[int],
    color: str = "speed",
    progress: Progress = lambda items, label: items,
) -> None:
    """Write frames one after another as GIF or MP4, 20 a second; the file appears when all is written.

    Args:
        file: Where to write; .gif or .mp4 says as what.
        trajectory: What to draw; several by their titles are drawn side by side, in the colours of the first.
        scene: Scene of the trajectories, 2D or 3D.
        frames: Indices of frames within the trajectories.
        color: As for `frames_chart`; the same colours hold for all frames.
        progress: Wraps the frames to show progress, given a label.

    Raises:
        ConfigError: If the name ends otherwise, ffmpeg is missing for .mp4, the file cannot be written, a frame is out
            of range, the colour unknown or the scene 1D.
    """
    writer = animation_writer(file)
    drawn = trajectory if isinstance(trajectory, Mapping) else {"": trajectory}
    first, *others = drawn.values()
    colorings = [_coloring(color, first, scene, frames, progress)]
    colorings += [_coloring(color, other, scene, frames, progress).as_in(colorings[0]) for other in others]
    stage = _stage(scene)
    title = scene.name if others else _title(first, scene)
    figure, panels = _set_up(stage, colorings[0], first, title, len(drawn))
    dpi = ANIMATION_DPI if len(drawn) == 1 else SIDE_BY_SIDE_DPI
    with whole_file(Path(file)) as partial, writer.saving(figure, partial, dpi):
        for k in progress(frames, "animation"):
            particles = [
                _draw_frame(axes, stage, coloring, each, scene, k, name)
                for axes, coloring, (name, each) in zip(panels, colorings, drawn.items(), strict=True)
            ]
            writer.grab_frame()
            for artist in particles:
                artist.remove()


def check_picture_name(file: str | Path) -> None:
    """Raise `ConfigError` unless the name ends in .png."""
    if Path(file).suffix.lower() != ".png":
        raise ConfigError(f"{file}: a picture is written as PNG; name a file that ends in .png.")


def animation_suffixes() -> tuple[str, ...]:
    """Suffixes of the animations that can be written here: .gif, and .mp4 where ffmpeg is found."""
    return (".gif", ".mp4") if FFMpegWriter.isAvailable() else (".gif",)


def animation_writer(file: str | Path) -> AbstractMovieWriter:
    """Matplotlib's writer of .gif or .mp4.

    Raises:
        ConfigError: If the name ends otherwise, or ffmpeg is missing for .mp4.
    """
    suffix = Path(file).suffix.lower()
    if suffix not in (".gif", ".mp4"):
        raise ConfigError(f"{file}: an animation is written as GIF or MP4; name a file that ends in .gif or .mp4.")
    if suffix == ".gif":
        return PillowWriter(fps=FRAMES_PER_SECOND)
    if not FFMpegWriter.isAvailable():
        raise ConfigError(f"{file}: MP4 needs the program ffmpeg, which is not found; install it or name a .gif file.")
    return FFMpegWriter(fps=FRAMES_PER_SECOND)


class _Coloring(Protocol):
    """What the colours of particles say."""

    def colors(self, k: int) -> np.ndarray:
        """RGBA of the particles at frame `k`, (N, 4)."""

    def draw_key(self, figure: Figure, panels: Sequence[Axes]) -> None:
        """Explain the colours beside the panels."""

    def as_in(self, other: Any) -> "_Coloring":
        """The same with the scale of another colouring of its kind, so that one key explains both."""


@dataclass(frozen=True)
class _ByValue:
    """A colour map of one number a particle; walls are grey."""

    values: dict[int, np.ndarray]  # by frame, each (N,)
    is_wall: np.ndarray
    scale: ScalarMappable
    label: str
    extend: str  # which ends of the scale have values beyond

    def colors(self, k: int) -> np.ndarray:
        colors = self.scale.to_rgba(self.values[k])
        colors[self.is_wall] = to_rgba(_WALL_COLOR)
        return colors

    def draw_key(self, figure: Figure, panels: Sequence[Axes]) -> None:
        bar = figure.colorbar(self.scale, ax=panels, label=self.label, extend=self.extend, pad=0.02, aspect=30)
        bar.outline.set_visible(False)

    def as_in(self, other: "_ByValue") -> "_ByValue":
        return replace(self, scale=other.scale)


@dataclass(frozen=True)
class _ByType:
    """One colour a particle type."""

    types: np.ndarray
    shows_boundary: bool

    def colors(self, k: int) -> np.ndarray:
        return to_rgba_array([_TYPE_COLORS[kind] for kind in ParticleType])[self.types - min(ParticleType)]

    def draw_key(self, figure: Figure, panels: Sequence[Axes]) -> None:
        present = [kind for kind in ParticleType if kind in self.types]
        entries = {kind.name.lower().replace("_", " "): _TYPE_COLORS[kind] for kind in present}
        if self.shows_boundary and not _is_wall(self.types).any():
            entries["boundary"] = _BOUNDARY_COLOR
        dots = [Line2D([], [], ls="", marker="o", color=color, label=label) for label, color in entries.items()]
        figure.legend(handles=dots, loc="outside right center", frameon=False)

    def as_in(self, other: "_ByType") -> "_ByType":
        return self


def _by_speed(trajectory: Frames, scene: Scene, frames: Iterable[int]) -> _ByValue:
    values = {k: speed(trajectory[k]).double().numpy() for k in frames}
    is_wall = _is_wall(trajectory.particle_types.numpy())
    top, beyond = _limit(values, is_wall, 0.995)
    scale = ScalarMappable(Normalize(0, top), "viridis")
    return _ByValue(values, is_wall, scale, "speed", "max" if beyond else "neither")


def _by_density(trajectory: Frames, scene: Scene, frames: Iterable[int]) -> _ByValue:
    values = {k: 100 * density_deviation(trajectory[k], scene).numpy() for k in frames}
    is_wall = _is_wall(trajectory.particle_types.numpy())
    top, beyond = _limit(values, is_wall, 0.9)
    scale = ScalarMappable(Normalize(-top, top), "coolwarm")
    return _ByValue(values, is_wall, scale, "density deviation [%]", "both" if beyond else "neither")


def _by_type(trajectory: Frames, scene: Scene, frames: Iterable[int]) -> _ByType:
    return _ByType(trajectory.particle_types.numpy(), scene.dim == 2 and trajectory.boundary is not None)


COLORINGS: dict[str, Callable[[Frames, Scene, Iterable[int]], _Coloring]] = {
    "speed": _by_speed,
    "density": _by_density,
    "type": _by_type,
}


def _coloring(color: str, trajectory: Frames, scene: Scene, frames: Sequence[int], progress: Progress) -> _Coloring:
    check_choice("color", color, COLORINGS)
    check_frames(trajectory, frames)
    return COLORINGS[color](trajectory, scene, progress(frames, color))


def _vertical_axis(force: Force | None) -> str:
    """Name of the axis along which a constant force is largest; y if there is none."""
    return "xyz"[int(np.argmax(np.abs(force.acceleration)))] if isinstance(force, ConstantForce) else "y"


def _is_wall(types: np.ndarray) -> np.ndarray:
    return np.isin(types, (ParticleType.SOLID_WALL, ParticleType.MOVING_WALL))


def _limit(values: dict[int, np.ndarray], is_wall: np.ndarray, quantile: float) -> tuple[float, bool]:
    """Largest magnitude that the scale shows, and whether some are beyond: a few outliers must not pale all others."""
    sizes = np.abs(np.concatenate([of_frame[~is_wall] for of_frame in values.values()]))
    if not sizes.any():
        return 1.0, False
    largest, usual = float(sizes.max()), float(np.quantile(sizes, quantile))
    return (usual, True) if 0 < usual < 0.8 * largest else (largest, False)


class _Stage(Protocol):
    """How axes show a scene."""

    aspect: float  # width of a panel by its height
    projection: str | None

    def prepare(self, axes: Axes, trajectory: Frames) -> None:
        """Limits, labels and what does not move."""

    def draw(self, axes: Axes, frame: Frame, colors: np.ndarray) -> Artist:
        """Particles of a frame."""


class _Plane:
    """Two dimensions: discs of area dx^2."""

    projection: str | None = None

    def __init__(self, scene: Scene):
        self._scene = scene
        self.aspect: float = scene.box.lengths[0] / scene.box.lengths[1]

    def prepare(self, axes: Axes, trajectory: Frames) -> None:
        box = self._scene.box
        axes.set(xlim=(box.lower[0], box.upper[0]), ylim=(box.lower[1], box.upper[1]), xlabel="x", ylabel="y")
        axes.set_aspect("equal")
        if trajectory.boundary is not None:
            self._discs(axes, trajectory.boundary.positions.numpy(), to_rgba(_BOUNDARY_COLOR))

    def draw(self, axes: Axes, frame: Frame, colors: np.ndarray) -> Artist:
        return self._discs(axes, frame.positions.numpy(), colors)

    def _discs(self, axes: Axes, points: np.ndarray, colors: np.ndarray | _RGBA) -> EllipseCollection:
        width = [math.sqrt(4 / math.pi) * self._scene.particle_spacing]
        discs = EllipseCollection(
            width, width, [0], units="xy", offsets=points, offset_transform=axes.transData, facecolors=colors, lw=0
        )
        axes.add_collection(discs, autolim=False)
        return discs


class _Space:
    """Three dimensions, seen from above; the axis of a constant force is vertical, y where there is none."""

    projection: str | None = "3d"
    aspect: float = 0.85

    def __init__(self, scene: Scene):
        self._scene = scene
        self._vertical = _vertical_axis(scene.force)

    def prepare(self, axes: Axes3D, trajectory: Frames) -> None:
        box = self._scene.box
        for axis, low, high in zip("xyz", box.lower, box.upper, strict=True):
            axes.set(**{f"{axis}lim": (low, high)})
            getattr(axes, f"set_{axis}label")(axis, labelpad=-4)
            axes.locator_params(axis=axis, nbins=4)
            axes.tick_params(axis=axis, pad=-1, labelsize=8)
        axes.set_proj_type("ortho")
        axes.view_init(elev=20, azim=-60, vertical_axis=self._vertical)
        axes.set_box_aspect(box.lengths)  # after the view, which turns it

    def draw(self, axes: Axes3D, frame: Frame, colors: np.ndarray) -> Artist:
        diameter = math.cbrt(6 / math.pi) * self._scene.particle_spacing * _points_per_length(axes, self._scene)
        colors = np.where(_is_wall(frame.particle_types.numpy())[:, None], to_rgba(_BOUNDARY_COLOR, 0.05), colors)
        return axes.scatter(
            *frame.positions.numpy().T,
            s=diameter**2,
            c=colors,
            ec=(0, 0, 0, 0.25),
            lw=0.3,
            depthshade=False,
            clip_on=False,
        )


def _points_per_length(axes: Axes3D, scene: Scene) -> float:
    """Printer's points that a unit of length in the plane of view takes, under parallel projection."""
    corners = np.array(scene.box.lower) + np.vstack([np.zeros(3), np.diag(scene.box.lengths)])
    pixels = axes.transData.transform(np.stack(proj_transform(*corners.T, axes.get_proj())[:2], axis=1))
    steps = (pixels[1:] - pixels[0]) / np.array(scene.box.lengths)[:, None]
    # The three axes' unit vectors, projected to a plane, have squared lengths that sum to 2.
    return math.sqrt((steps**2).sum() / 2) * 72 / axes.figure.dpi


def _stage(scene: Scene) -> _Stage:
    if scene.dim == 1:
        raise ConfigError(f"a picture needs 2 or 3 dimensions, {scene.name} has 1; export it to VTK instead.")
    return _Plane(scene) if scene.dim == 2 else _Space(scene)


def _set_up(
    stage: _Stage, coloring: _Coloring, trajectory: Frames, title: str, count: int
) -> tuple[Figure, list[Axes]]:
    """A figure of `count` panels that lacks only the particles."""
    rows, columns = _grid(count, stage.aspect)
    width = min(12 / columns, 6.5 / rows * stage.aspect)
    size = (columns * width + 1.6, rows * (width / stage.aspect + 0.35) + 0.8)
    with sns.axes_style("ticks"):
        figure = Figure(figsize=size, layout="constrained")
        shared = stage.projection is None
        grid = figure.subplots(
            rows, columns, squeeze=False, sharex=shared, sharey=shared, subplot_kw={"projection": stage.projection}
        )
    panels, spare = list(grid.flat[:count]), grid.flat[count:]
    for axes in spare:
        axes.remove()
    for axes in panels:
        stage.prepare(axes, trajectory)
    if shared:
        _label_outer(panels, columns)
    figure.suptitle(title, fontsize=12)
    coloring.draw_key(figure, panels)
    figure.draw_without_rendering()  # places the panels, from which 3D markers take their size
    return figure, panels


def _title(trajectory: Frames, scene: Scene) -> str:
    return f"{scene.name}, trajectory {trajectory.name}"


def _grid(count: int, aspect: float) -> tuple[int, int]:
    """Rows and columns of panels that together are about 2.2 times as wide as high, with few places left empty."""

    def misfit(columns: int) -> float:
        rows = math.ceil(count / columns)
        return abs(math.log(columns * aspect / rows / 2.2)) + 0.3 * (rows * columns - count)

    columns = min(range(1, count + 1), key=misfit)
    return math.ceil(count / columns), columns


def _label_outer(panels: Sequence[Axes], columns: int) -> None:
    """Axis labels only at the left of each row and below each column."""
    for index, axes in enumerate(panels):
        axes.label_outer()
        if index + columns >= len(panels):
            axes.tick_params(labelbottom=True)
            axes.set_xlabel("x")


def _draw_frame(
    axes: Axes, stage: _Stage, coloring: _Coloring, trajectory: Frames, scene: Scene, k: int, title: str = ""
) -> Artist:
    moment = f"frame {trajectory.first_frame + k if title else k}, t = {time_of(trajectory, k, scene.frame_dt):.4g}"
    axes.set_title(f"{title}: {moment}" if title else moment, fontsize=10)
    return stage.draw(axes, trajectory[k], coloring.colors(k))
