"""Charts of what decides the error. Each function returns a matplotlib figure; showing or saving it is the caller's."""

import math
from collections.abc import Mapping, Sequence

import seaborn as sns
from matplotlib.axes import Axes
from matplotlib.figure import Figure

_ABOVE, _BELOW, _FLOOR, _POINTS = "#4c72b0", "0.75", "#c44e52", "0.45"
_METHODS = {"f_anova": "share of variance (f-ANOVA)", "ped_anova": "share of what sets the best apart (PED-ANOVA)"}


def importance_chart(entries: Sequence[Mapping], title: str = "importance of hyperparameters") -> Figure:
    """Bars of importance with intervals and the floor of noise: a row a rung, a column a method.

    Args:
        entries: Of `cconv.study.importance.importance_by_rung`.
        title: Title of the figure.
    """
    names = _by_importance(entries)
    with sns.axes_style("whitegrid"):
        figure = Figure(figsize=(11, max(2.2, 0.8 + 0.24 * len(names)) * len(entries) + 0.4), layout="constrained")
        panels = figure.subplots(len(entries), 2, squeeze=False, sharey=True, sharex="col")
    for row, entry in zip(panels, entries, strict=True):
        for axes, method in zip(row, _METHODS, strict=True):
            _bars(axes, entry[method], names)
            axes.set_title(_METHODS[method] if method == "ped_anova" else f"{_METHODS[method]}\n{_quality(entry)}")
        row[0].set_ylabel(_sample(entry))
    panels[0, 0].invert_yaxis()
    for axes in panels[0]:
        axes.set_xlim(left=0)
    panels[0, 1].legend(loc="lower right", fontsize=8)
    figure.suptitle(title)
    return figure


def partial_dependence_chart(dependences: Sequence[Mapping], columns: int = 3) -> Figure:
    """Error against each hyperparameter: the surrogate's mean with the middle 80 % of its trees, and the raw trials.

    Args:
        dependences: Of `cconv.study.partial_dependence.partial_dependence`, most important first.
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
        axes.set_ylabel("validation error\n(normalized MSE)")
    panels[0].legend(fontsize=8)
    first = dependences[0]
    figure.suptitle(
        f"error by hyperparameter after {first['updates']:,} updates, {first['trials']} trials\n{_quality(first)}"
    )
    return figure


def _by_importance(entries: Sequence[Mapping]) -> list[str]:
    judged = entries[0]["f_anova"]["parameters"]
    return sorted(judged, key=lambda name: -judged[name]["importance"])


def _bars(axes: Axes, found: Mapping, names: Sequence[str]) -> None:
    judged = [found["parameters"][name] for name in names]
    colors = [_ABOVE if each["above_noise"] else _BELOW for each in judged]
    axes.barh(range(len(names)), [each["importance"] for each in judged], color=colors, height=0.65)
    lows, highs = ([each[end] for each in judged] for end in ("low", "high"))
    axes.hlines(range(len(names)), lows, highs, color="0.15", lw=1.2, label="95 % over resampled trials")
    axes.axvline(found["noise_floor"], color=_FLOOR, ls="--", lw=1.2, label="floor of noise (dummy)")
    axes.set_yticks(range(len(names)), names)
    axes.grid(axis="y", visible=False)


def _quality(found: Mapping) -> str:
    r2 = found["surrogate_r2"]
    return "all errors are equal" if r2 is None else f"surrogate's R² on unseen trials {r2:.2f}"


def _sample(entry: Mapping) -> str:
    left = ", those not stopped" if entry["censored"] else ""
    return f"{entry['updates']:,} updates\n{entry['trials']} trials{left}"


def _dependence(axes: Axes, dependence: Mapping) -> None:
    choice, values = dependence["scale"] == "choice", dependence["values"]
    positions = list(range(len(values))) if choice else values
    drawn = [point["value"] for point in dependence["points"]]
    x = [values.index(value) for value in drawn] if choice else drawn
    axes.plot(x, [point["error"] for point in dependence["points"]], ".", color=_POINTS, alpha=0.6, ms=5, label="trial")
    axes.set(yscale="log", title=dependence["parameter"], xscale="log" if dependence["scale"] == "log" else "linear")
    if not choice:
        axes.fill_between(positions, dependence["low"], dependence["high"], color=_ABOVE, alpha=0.2, lw=0)
        axes.plot(positions, dependence["error"], color=_ABOVE, label="surrogate", zorder=3)
        return
    axes.vlines(positions, dependence["low"], dependence["high"], color=_ABOVE, lw=1.5)
    axes.plot(positions, dependence["error"], "o", color=_ABOVE, label="surrogate", zorder=3)
    labels = [str(value) for value in values]
    axes.set_xticks(positions, [label.replace("_to_", "_to_\n", 1) for label in labels])
    axes.tick_params(axis="x", labelsize=8)
    axes.set_xlim(-0.5, len(values) - 0.5)
