"""Charts of a study. Each function returns a matplotlib figure of its own; showing or saving it is the caller's."""

from collections.abc import Callable, Sequence
from typing import Any, cast

import pandas as pd
import seaborn as sns
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.figure import Figure
from matplotlib.ticker import LogFormatter
from matplotlib.typing import ColorType

from cconv.report.colors import MARKED, MEAN_COLOR, stage_colors
from cconv.report.tables import AUDIT_MEASURES, MEAN_PREDICTOR, growth_table, rung_audit_table, strategies_table
from cconv.report.verdicts import verdict_matrix
from cconv.study.declared.stage import BASELINE
from cconv.study.records.found import Ablation
from cconv.study.records.summary import Summary

_BESIDE = {"loc": "upper left", "bbox_to_anchor": (1, 1)}  # a legend that hides no point


def learning_curves_chart(curves: pd.DataFrame, summary: Summary | None = None) -> Figure:
    """Validation error against gradient updates, one line a search trial, and one for each retraining beside them.

    Args:
        curves: `curves_table` of a run.
        summary: Tells what errors are called, and that of predicting the mean, drawn as a line; None where the study
            has not finished.
    """
    figure, (search, finals) = new_panels(11, 4.2, columns=2)
    trials, retrained = curves[~curves["retrained"]], curves[curves["stage"] == "finalists"]
    stages = stage_colors(list(trials["stage"].unique()))
    for (_, stage), curve in trials.groupby(["name", "stage"]):
        search.plot(curve["updates"], curve["valid_error"], color=stages[stage], alpha=0.6, marker=".", lw=1)
    for stage, color in stages.items():
        search.plot([], [], color=color, label=stage)
    challengers = sorted(set(retrained["name"]) - {BASELINE})
    palette = sns.color_palette("husl", len(challengers))
    colors = {BASELINE: MARKED["baseline"]} | dict(zip(challengers, palette, strict=True))
    for name, lines in retrained.groupby("name"):
        _draw_seeds(finals, lines, "updates", name, colors[name])
    for axes, title in ((search, "search"), (finals, "finalists, one line a seed")):
        axes.set(yscale="log", xlabel="gradient updates", ylabel=_error_label(summary), title=title)
        if summary is not None:
            mark_mean_predictor(axes.axhline, summary.mean_predictor.valid)
        _legend(axes)
    return figure


def budget_chart(curves: pd.DataFrame, models: Sequence[str], error: str) -> Figure:
    """Validation error of every training of some models against gradient updates, and against training seconds.

    Args:
        curves: Evaluations as `curves_table` gives them.
        models: Their ids, each of which has a colour.
        error: What the error is called.
    """
    figure, panels = new_panels(12, 4.4, columns=2)
    is_shown = curves["retrained"] & curves["name"].isin(models) & curves["valid_error"].notna()
    shown = curves[is_shown]
    colors = dict(zip(models, sns.color_palette("husl", len(models)), strict=True))
    for axes, x, label in zip(panels, ("updates", "seconds"), ("gradient updates", "training time [s]"), strict=True):
        for name, lines in shown.groupby("name", sort=False):
            _draw_seeds(axes, lines, x, name, colors[name])
        axes.set(yscale="log", xlabel=label, ylabel=f"validation error ({error})")
    trained = shown["updates"][shown["updates"] > 0]
    panels[0].set_xscale("symlog", linthresh=trained.min() if len(trained) else 1)  # least squares takes no update
    panels[0].set(title="error against updates, one line a seed", xlim=(0, None))
    panels[1].set(title="error against time", xscale="log")
    _legend(panels[1], **_BESIDE)
    return figure


def best_so_far_chart(trials: pd.DataFrame, summary: Summary | None = None) -> Figure:
    """Smallest validation error found against trials begun, and each trial's error by outcome.

    Args:
        trials: `trials_table` of a run.
        summary: As in `learning_curves_chart`.
    """
    figure, axes = new_figure(7.5, 4)
    order = range(1, len(trials) + 1)
    sns.scatterplot(
        x=list(order), y=trials["valid_error"], hue=trials["outcome"], style=trials["stage"], ax=axes, zorder=3
    )
    complete = trials["valid_error"].where(trials["outcome"] == "completed")
    axes.step(order, complete.cummin().ffill(), where="post", color="0.5", label="best of the full budget")
    axes.set(
        yscale="log", xlabel="trial, in order", ylabel=f"last {_error_label(summary)}", title="error of each trial"
    )
    if summary is not None:
        mark_mean_predictor(axes.axhline, summary.mean_predictor.valid)
    _legend(axes, **_BESIDE)
    return figure


def strategies_chart(summary: Summary) -> Figure:
    """Smallest validation error against gradient updates spent, one line a search strategy."""
    figure, axes = new_figure(7.5, 4)
    for name, curve in strategies_table(summary).groupby("strategy", sort=False):
        axes.step(curve["updates"], curve["error"], where="post", marker=".", label=name)
    axes.set(yscale="log", xlabel="gradient updates spent", ylabel=_error_label(summary))
    axes.set_title("best so far, by strategy")
    mark_mean_predictor(axes.axhline, summary.mean_predictor.valid)
    _legend(axes, **_BESIDE)
    return figure


def rung_audit_chart(summary: Summary) -> Figure:
    """What the order of the trials at each rung says of the order at the full budget.

    The rank correlation has its 95 % interval, from twelve trials on. A rung that too few trials reached has no point.
    """
    table = rung_audit_table(summary)
    figure, panels = new_panels(10, 3.3, columns=len(AUDIT_MEASURES))
    panels[0].vlines(table["updates"], table["spearman_low"], table["spearman_high"])
    for axes, name in zip(panels, AUDIT_MEASURES, strict=True):
        axes.plot(table["updates"], table[name].astype(float), marker="o")
        label = "final error ÷ the best" if name == "regret" else AUDIT_MEASURES[name]
        axes.set(xscale="log", xlabel="gradient updates at the rung", ylabel=label, title=AUDIT_MEASURES[name])
        axes.set_xticks(table["updates"], table["updates"], minor=False)
        axes.minorticks_off()
    return figure


def growth_chart(summary: Summary) -> Figure:
    """Time per frame against the number of particles, log axes, one line a model; bands are quartiles."""
    figure, axes = new_figure(7.5, 4.2)
    exponents = summary.growth.exponents
    for name, times in growth_table(summary).groupby("model", sort=False):
        label = f"{name}: ∝ N^{exponents[name]:.2f}" if name in exponents else name
        (line,) = axes.plot(times["num_particles"], times["ms_per_frame"], marker="o", label=label)
        particles, color = times["num_particles"], line.get_color()
        axes.fill_between(particles, times["ms_low"], times["ms_high"], color=color, alpha=0.2, lw=0)
    axes.set(xscale="log", yscale="log", xlabel="particles N", ylabel="time per frame [ms]", title="growth of the cost")
    _legend(axes, **_BESIDE)
    return figure


def cost_chart(summary: Summary) -> Figure:
    """Time per frame of each finalist, geometry and network apart, fastest first."""
    costs = {entry.id: entry.cost for entry in summary.finalists}
    names = sorted(costs, key=lambda name: costs[name].ms_per_frame)
    figure, axes = new_figure(8, 1.4 + 0.36 * len(names))
    geometry, network = zip(*((costs[name].geometry_ms, costs[name].network_ms) for name in names), strict=True)
    axes.barh(names, geometry, color="0.7", label="geometry")
    axes.barh(names, network, left=geometry, color=MARKED["finalist"], label="network")
    axes.invert_yaxis()
    axes.set(xlabel="time per frame [ms]", title="where the time goes")
    _legend(axes)
    return figure


def stability_chart(summary: Summary) -> Figure:
    """Each finding of the checks of stability by its limit, log axis: left of the line at 1 a finalist passes."""
    rows = verdict_matrix(summary)
    places = range(len(rows))
    figure, axes = new_figure(9, 1.6 + 0.3 * len(rows))
    for number, entry in enumerate(summary.finalists):
        axes.plot([row.cells[number].value / row.limit for row in rows], places, "o", alpha=0.8, label=entry.id)
    axes.axvline(1, color=MARKED["baseline"], lw=1.2)
    axes.set_yticks(places, [f"{row.check}: {row.label}" for row in rows])
    axes.invert_yaxis()
    axes.set(xscale="log", xlabel="measured by limit", title="checks of stability")
    _legend(axes)
    return figure


def ablation_chart(summary: Summary) -> Figure:
    """Validation error on the way from the baseline to the best, one change after the other, each retrained.

    Args:
        summary: That of a study with an ablation.
    """
    path = pd.DataFrame(map(dict, cast(Ablation, summary.ablation).path))
    figure, axes = new_figure(8, 1.2 + 0.38 * len(path))
    error, low, high = (path[name].astype(float) for name in ("valid_error", "low", "high"))
    places, bars = range(len(path)), [(error - low).clip(lower=0), (high - error).clip(lower=0)]
    axes.errorbar(error, places, xerr=bars, fmt="o-", capsize=3, color=MARKED["finalist"])
    axes.set_yticks(places, [str(change) for change in path["change"]])
    axes.invert_yaxis()
    axes.set(xscale="log", xlabel=_error_label(summary), title="from the baseline to the best")
    mark_mean_predictor(axes.axvline, summary.mean_predictor.valid)
    _legend(axes)
    return figure


def mark_mean_predictor(draw_line: Callable, error: float) -> None:
    """Draw what a model must be below to know anything: the error of predicting the mean on the split of the chart.

    Args:
        draw_line: `axhline` or `axvline` of the axes.
        error: That error.
    """
    draw_line(error, color=MEAN_COLOR, lw=1.2, ls="--", label=f"{MEAN_PREDICTOR}: {error:.3g}")


def label_few_decades(axis: Axis) -> None:
    """Label a logarithmic axis between the powers of ten too, as it may hold one or none of them."""
    for set_formatter in (axis.set_major_formatter, axis.set_minor_formatter):
        set_formatter(LogFormatter(minor_thresholds=(1.5, 0.6)))


def new_figure(width: float, height: float) -> tuple[Figure, Axes]:
    """An empty figure in the style of the report, width and height in inches, with its axes."""
    figure, (axes,) = new_panels(width, height, columns=1)
    return figure, axes


def new_panels(width: float, height: float, columns: int) -> tuple[Figure, list[Axes]]:
    """An empty figure in the style of the report, width and height in inches, with several axes side by side."""
    with sns.axes_style("whitegrid"):
        figure = Figure(figsize=(width, height), layout="constrained")
        return figure, list(figure.subplots(1, columns, squeeze=False).flat)


def _draw_seeds(axes: Axes, lines: pd.DataFrame, x: str, name: str, color: ColorType) -> None:
    """Draw the validation errors of a finalist against a column of `lines`, one line a seed."""
    for number, (_, curve) in enumerate(lines.groupby("seed")):
        marker, label = "." if len(curve) == 1 else "", None if number else name
        axes.plot(curve[x], curve["valid_error"], marker=marker, color=color, label=label, lw=1.2)


def _error_label(summary: Summary | None) -> str:
    return "validation error" if summary is None else f"validation error ({summary.task.error})"


def _legend(axes: Axes, **place: Any) -> None:
    if axes.get_legend_handles_labels()[0]:
        axes.legend(fontsize=8, **place)
