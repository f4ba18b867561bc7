"""What a model has learned, drawn from the arrays of `cconv.evaluation.explanation`.

Neither Ray nor torch is imported.
"""

import io
import zlib
from collections.abc import Iterable, Mapping
from pathlib import Path
from zipfile import BadZipFile

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from cconv.errors import DataError
from cconv.report.colors import ANALYTIC_COLOR, MARKED
from cconv.report.plots import new_figure, new_panels
from cconv.study.records.run_folder import RunFolder

Explanation = Mapping[str, np.ndarray]
_LEARNED = MARKED["recommended"]


def read_explanations(run: RunFolder, explained: Iterable[str]) -> dict[str, dict[str, np.ndarray]]:
    """Arrays of each explained finalist by id, from ``explanation/<id>.npz``.

    Raises:
        DataError: If a file is missing or damaged.
    """
    return {name: _read(run.path / "explanation" / f"{name}.npz") for name in explained}


def filters_chart(explanation: Explanation) -> Figure:
    """Filters of the first layer against the analytic ones: along each axis, and radially with their spread.

    Panels along the axes have the features that the analytic operator reads, in the component along the axis.
    """
    dim = len(explanation["learned_on_axes"])
    spacing = float(explanation["particle_spacing"])
    figure, panels = new_panels(3.6 * (dim + 1), 3.6, columns=dim + 1)
    for axis, axes in enumerate(panels[:-1]):
        _draw_axis(axes, explanation, axis, spacing)
    _draw_radial(panels[-1], explanation, spacing)
    for axes in panels:
        for radius in (explanation["cutoff"], explanation["support"]):
            axes.axvline(float(radius) / spacing, color="0.8", lw=0.8, zorder=0)
    combined = "outputs combined by least squares" if explanation["is_combined"] else "as they are"
    differing = f"differ by {100 * float(explanation['unexplained']):.2g} % of |∇W|²"
    figure.suptitle(f"filters of the first layer, {combined}, {differing}")
    for axes in panels:
        axes.set_ylabel("filter [units of the data]")
    return figure


def fields_chart(explanation: Explanation, symbol: str) -> Figure:
    """Target, prediction and error on a frame; in three dimensions a slice of two spacings through the middle.

    Args:
        explanation: Arrays of a model.
        symbol: Symbol of the field; vectors are drawn by their length.
    """
    shown = _slice(explanation)
    positions, target, prediction = (explanation[name][shown] for name in ("positions", "target", "prediction"))
    error = np.sqrt(explanation["error"][shown])
    if target.shape[1] > 1:
        target, prediction, symbol = _size(target), _size(prediction), f"|{symbol}|"
    figure, panels = new_panels(13, 3.9, columns=3)
    limit = float(np.quantile(np.abs(target), 0.99)) or 1.0
    signed = {"cmap": "RdBu_r", "vmin": -limit, "vmax": limit}
    scale = signed if np.any(target < 0) else {"cmap": "viridis", "vmin": 0, "vmax": limit}
    for axes, values, title in (
        (panels[0], target, f"analytic {symbol}"),
        (panels[1], prediction, f"predicted {symbol}"),
    ):
        _draw_particles(axes, positions, values.ravel(), title, "units of the data", scale)
    largest = {"cmap": "magma_r", "vmin": 0, "vmax": float(np.quantile(error, 0.99)) or 1.0}
    _draw_particles(panels[2], positions, error, "error of each particle", "standard deviations of the target", largest)
    return figure


def error_distribution_chart(explanations: Mapping[str, Explanation], baseline: str, best: str) -> Figure:
    """How the errors of single particles are spread: share of the particles by error, baseline against best."""
    figure, axes = new_figure(8, 3.8)
    colors = {baseline: MARKED["baseline"], best: MARKED["recommended"]}
    shown = [name for name in colors if name in explanations]
    for name in shown:
        color = colors[name]
        bins, counts = explanations[name]["error_bins"], explanations[name]["error_counts"]
        label = f"{name} (recommended)" if name == best else name
        axes.stairs(counts / counts.sum(), bins, fill=True, alpha=0.35, color=color)
        axes.stairs(counts / counts.sum(), bins, color=color, label=label)
        median = explanations[name]["error_quantiles"][list(explanations[name]["error_levels"]).index(0.5)]
        axes.axvline(median, color=color, lw=1, ls="--")
    axes.set_title("errors of single particles")
    _fit_range(axes, [explanations[name] for name in shown])
    axes.set(
        xscale="log", xlabel="error of a particle, by the target's standard deviation", ylabel="share of particles"
    )
    axes.legend(fontsize=8, title="dashed: median")
    return figure


def _read(path: Path) -> dict[str, np.ndarray]:
    try:
        # From memory, as numpy leaves a file open that it cannot read.
        with np.load(io.BytesIO(path.read_bytes()), allow_pickle=False) as arrays:
            return dict(arrays)
    except (OSError, EOFError, ValueError, BadZipFile, zlib.error) as error:
        raise DataError(f"{path}: no arrays of a model's explanation ({error}); delete or restore it.") from error


def _draw_axis(axes: Axes, explanation: Explanation, axis: int, spacing: float) -> None:
    """The velocity component along the axis for a scalar target, the density for the component along the axis."""
    learned, analytic = explanation["learned_on_axes"][axis], explanation["analytic_on_axes"][axis]
    names, name = list(explanation["feature_names"]), "xyz"[axis]
    feature, component = (names.index("ρ"), axis) if learned.shape[2] > 1 else (names.index(f"v_{name}"), 0)
    line = explanation["line"] / spacing
    axes.plot(line, analytic[:, feature, component], color=ANALYTIC_COLOR, lw=3, alpha=0.25, label="analytic: ∇W")
    axes.plot(line, learned[:, feature, component], color=_LEARNED, lw=1.4, label="learned")
    axes.set(xlabel=f"offset along {name} [spacings]", title=f"{names[feature]} along {name}")
    axes.legend(fontsize=8)


def _draw_radial(axes: Axes, explanation: Explanation, spacing: float) -> None:
    radii = explanation["radii"] / spacing
    axes.plot(radii, explanation["analytic_radial"], color=ANALYTIC_COLOR, lw=3, alpha=0.25, label="analytic: W'(r)")
    axes.plot(radii, explanation["learned_radial"], color=_LEARNED, lw=1.4, label="learned, mean over directions")
    low, high = explanation["learned_radial_low"], explanation["learned_radial_high"]
    axes.fill_between(radii, low, high, color=_LEARNED, alpha=0.2, lw=0, label="9 of 10 directions")
    axes.set(xlabel="distance r [spacings]", title="part along the direction d/r")
    axes.legend(fontsize=8)


def _slice(explanation: Explanation) -> np.ndarray:
    positions = explanation["positions"]
    if positions.shape[1] < 3:
        return np.ones(len(positions), dtype=bool)
    depth = positions[:, 2] - np.median(positions[:, 2])
    return np.abs(depth) <= float(explanation["particle_spacing"])


def _draw_particles(
    axes: Axes, positions: np.ndarray, values: np.ndarray, title: str, unit: str, scale: Mapping
) -> None:
    height = positions[:, 1] if positions.shape[1] > 1 else np.zeros(len(positions))
    size = np.clip(40_000 / len(positions), 2, 40)
    drawn = axes.scatter(positions[:, 0], height, c=values, s=size, linewidths=0, rasterized=True, **scale)
    axes.set(
        aspect="equal", xlabel="x [length]", ylabel="y [length]" if positions.shape[1] > 1 else "none", title=title
    )
    axes.grid(False)
    axes.figure.colorbar(drawn, ax=axes, extend="both", shrink=0.8, label=unit)


def _size(vectors: np.ndarray) -> np.ndarray:
    return np.linalg.norm(vectors, axis=1)


def _fit_range(axes: Axes, explanations: list[Explanation]) -> None:
    """Limit the error axis to bins that hold particles."""
    filled = [np.flatnonzero(explanation["error_counts"]) for explanation in explanations]
    bins = explanations[0]["error_bins"]
    axes.set_xlim(bins[min(places.min() for places in filled)], bins[max(places.max() for places in filled) + 1])
