"""Charts of what decides the error. Each function returns a matplotlib figure; showing or saving it is the caller's."""

import math
from collections.abc import Sequence
from typing import cast

import seaborn as sns
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from cconv.study.records.found import PartialDependence, RungImportance

_FOUND, _OPEN, _LIMIT, _POINTS = "#4c72b0", "0.75", "#c44e52", "0.45"
_TREES = "middle 80 % of its trees"
_METHODS = {"f_anova": ("f-ANOVA: share of the variance", "o"), "ped_anova": ("PED-ANOVA: share of the sum", "D")}


def importance_chart(entries: Sequence[RungImportance], title: str = "importance of hyperparameters") -> Figure:
    """Shares of the variance with intervals, found or not, and beside them two estimates without: a row a rung.

    Args:
        entries: One a rung, one or more with importances; the others are left out.
        title: Title of the figure.
    """
    entries = [entry for entry in entries if entry.parameters]
    names = _by_share(entries[0])
    with sns.axes_style("whitegrid"):
        figure = Figure(figsize=(11, max(2.6, 1.2 + 0.24 * len(names)) * len(entries) + 0.8), layout="constrained")
        panels = figure.subplots(len(entries), 2, squeeze=False, sharey=True, sharex=True)
    for (tested, estimated), entry in zip(panels, entries, strict=True):
        _shares(tested, entry, names)
        _estimates(estimated, entry, names)
        tested.set_ylabel(_sample(entry))
    for axes in panels[-1]:
        axes.set_xlabel("share, from 0 to 1")
    panels[0, 0].invert_yaxis()
    panels[0, 0].set_xlim(0, 1)
    for column in (0, 1):
        handles, labels = panels[0, column].get_legend_handles_labels()
        panels[-1, column].legend(handles, labels, fontsize=8, loc="upper center", bbox_to_anchor=(0.5, -0.12))
    figure.suptitle(title)
    return figure


def partial_dependence_chart(dependences: Sequence[PartialDependence], columns: int = 3) -> Figure:
    """Error against each hyperparameter: the surrogate's mean with the middle 80 % of its trees, and the raw trials.

    How far the trees differ is no confidence interval, and the legend says what is drawn.

    Args:
        dependences: One a hyperparameter, most important first.
        columns: Panels in a row.
    """
    rows = math.ceil(len(dependences) / columns)
    with sns.axes_style("whitegrid"):
        figure = Figure(figsize=(3.6 * columns, 2.9 * rows + 0.4), layout="constrained")
        panels = figure.subplots(rows, columns, squeeze=False, sharey=True).flatten()
    for axes, dependence in zip(panels, dependences, strict=False):
        _dependence(axes, dependence)
    for axes in panels[len(dependences) :]:
        axes.remove()
    for axes in panels[: len(dependences) : columns]:
        axes.set_ylabel("validation error")
    panels[0].legend(fontsize=8)
    first = dependences[0]
    counts = f"after {first.updates:,} updates, {first.trials} trials"
    figure.suptitle(f"error by hyperparameter {counts}\n{_quality(first.surrogate_r2)}")
    return figure


def _by_share(entry: RungImportance) -> list[str]:
    judged = entry.parameters
    return sorted(judged, key=lambda name: -(judged[name].share or 0.0))


def _shares(axes: Axes, entry: RungImportance, names: Sequence[str]) -> None:
    judged = [entry.parameters[name] for name in names]
    tested = {row: each.tested for row, each in enumerate(judged) if each.tested is not None}
    for decided, color, label in ((True, _FOUND, "found"), (False, _OPEN, "not found, which is not absent")):
        rows = [row for row in tested if judged[row].decided is decided]
        axes.barh(rows, [tested[row].share for row in rows], color=color, height=0.65, label=label)
    lows, highs = [each.low for each in tested.values()], [each.high for each in tested.values()]
    axes.hlines(list(tested), lows, highs, color="0.15", lw=1.2, label="95 % interval of the share")
    detectable = cast(float, entry.detectable_share)  # which an entry with importances has
    axes.axvline(detectable, color=_LIMIT, ls="--", lw=1.2, label="found four times in five from here on")
    axes.set_yticks(range(len(names)), names)
    axes.grid(axis="y", visible=False)
    axes.set_title("share of the variance that it decides alone", fontsize=11)


def _estimates(axes: Axes, entry: RungImportance, names: Sequence[str]) -> None:
    for method, (label, marker) in _METHODS.items():
        values = [getattr(entry.parameters[name], method) for name in names]
        axes.plot(values, range(len(names)), marker, ms=5, label=label, alpha=0.8)
    axes.set_title(f"estimates without intervals\n{_quality(entry.surrogate_r2)}", fontsize=11)


def _quality(r2: float | None) -> str:
    return "all errors are equal" if r2 is None else f"surrogate's R² on unseen trials {r2:.2f}"


def _sample(entry: RungImportance) -> str:
    left = ", those not stopped" if entry.censored else ""
    return f"{entry.updates:,} updates\n{entry.trials} trials{left}"


def _dependence(axes: Axes, dependence: PartialDependence) -> None:
    choice, values = dependence.scale == "choice", dependence.values
    positions = list(range(len(values))) if choice else values
    drawn = [point.value for point in dependence.points]
    x = [values.index(value) for value in drawn] if choice else drawn
    axes.plot(x, [point.error for point in dependence.points], ".", color=_POINTS, alpha=0.6, ms=5, label="trial")
    axes.set(yscale="log", title=dependence.parameter, xlabel="value")
    axes.set_xscale("log" if dependence.scale == "log" else "linear")
    if not choice:
        axes.fill_between(positions, dependence.low, dependence.high, color=_FOUND, alpha=0.2, lw=0, label=_TREES)
        axes.plot(positions, dependence.error, color=_FOUND, label="surrogate", zorder=3)
        return
    axes.vlines(positions, dependence.low, dependence.high, color=_FOUND, lw=1.5, label=_TREES)
    axes.plot(positions, dependence.error, "o", color=_FOUND, label="surrogate", zorder=3)
    labels = [str(value) for value in values]
    axes.set_xticks(positions, [label.replace("_to_", "_to_\n", 1) for label in labels])
    axes.tick_params(axis="x", labelsize=8)
    axes.set_xlim(-0.5, len(values) - 0.5)
