"""The chart of a study: error against time per frame, for print and notebooks. `interactive` has the one to hover over.

Finalists stand out, with intervals; trials and closed forms of the search are small and faded.
"""

from functools import partial
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from cconv.report.colors import ANALYTIC_COLOR, MARKED, PUBLISHED_COLOR, SOLVER_COLOR, stage_colors
from cconv.report.plots import label_few_decades, mark_mean_predictor, new_figure
from cconv.report.published import published_errors
from cconv.report.tables import ANALYTIC, end_of_bar, speed_accuracy_table
from cconv.study.records.summary import Summary

_MARKERS = {"recommended": ("*", 17), "baseline": ("s", 9), "thesis's best": ("D", 8), "finalist": ("o", 8)}


def speed_accuracy_chart(summary: Summary) -> Figure:
    """Error against time per frame, log axes: finalists, search, front, analytic SPH, the solver that made the data.

    Vertical bars are 95 % intervals over seeds and test units, where there are enough for one; one that ends at its
    point has no upper end. Horizontal bars are the quartiles of the timing. The front was found by validation errors;
    the dashed line is predicting the mean on the test split. Each finalist is named in the margin, at the end of a thin
    line from its point. Trials of the search have validation errors and mostly estimated times; those that were stopped
    are hollow. The solver is drawn with coarser ones, which are cheaper. Dotted lines are errors that others published
    for the same data; they have no time.
    """
    points = speed_accuracy_table(summary)
    finalists = points[points["kind"] == "finalist"].sort_values("error", ascending=False)
    figure, axes = new_figure(10.5, max(5.5, 0.42 * len(finalists)))
    axes.set(xscale="log", yscale="log", xlabel="time per frame [ms]", ylabel=f"error ({summary.task.error})")
    _draw_search(axes, points[points["kind"] == "search"])
    _draw_front(axes, summary, finalists)
    for row in finalists.itertuples():
        _draw_finalist(axes, row)
    _draw_solvers(axes, points[points["kind"] == "solver"])
    trivial = summary.mean_predictor.test
    axes.set_ylim(*error_range(points, trivial, *published_errors(summary).values()))
    for name, error in published_errors(summary).items():
        axes.axhline(error, color=PUBLISHED_COLOR, lw=0.9, ls=":", zorder=1, label=f"{name}, published: {error:.3g}")
    mark_mean_predictor(axes.axhline, trivial)
    _draw_analytic(axes, points[points["kind"] == "analytic"])
    _name_in_margin(axes, finalists)
    label_few_decades(axes.xaxis)
    threads = summary.finalists[0].cost.threads
    axes.set_title(f"{summary.study}: error against cost ({threads} thread{'s' * (threads > 1)})")
    figure.legend(*axes.get_legend_handles_labels(), loc="outside lower center", ncols=5, fontsize=8, frameon=False)
    return figure


def error_range(points: pd.DataFrame, mean_predictor: float, *published: float) -> tuple[float, float]:
    """Lower and upper end of the error axis: all finalists, solvers, the mean predictor, published errors.

    Trials are within it up to ten times the worst finalist.
    """
    finalists = points[points["kind"] == "finalist"]
    highest = max(end_of_bar(row.error, row.error_low, row.error_high) for row in finalists.itertuples())
    errors = points.loc[points["error"].between(0, 10 * highest, inclusive="neither"), "error"]
    solvers = points.loc[(points["kind"] == "solver") & (points["error"] > 0), "error"]
    lowest = np.nanmin(
        [errors.min(), finalists["error_low"][finalists["error_low"] > 0].min(), solvers.min(), *published]
    )
    return lowest / 3, 2 * np.nanmax([errors.max(), highest, mean_predictor, solvers.max(), *published])


def _draw_search(axes: Axes, search: pd.DataFrame) -> None:
    colors = stage_colors(list(search["group"].unique()))
    for stage, trials in search.groupby("group", sort=False):
        filled = trials["outcome"] == "completed"
        draw = partial(axes.scatter, s=16, alpha=0.5, linewidths=0.8, edgecolors=colors[stage], zorder=2)
        draw(trials["ms"][filled], trials["error"][filled], color=colors[stage], label=stage)
        label = None if filled.any() else stage
        draw(trials["ms"][~filled], trials["error"][~filled], facecolors="none", label=label)
    if (search["outcome"] != "completed").any():
        axes.scatter([], [], s=16, facecolors="none", edgecolors="0.5", label="stopped early")


def _draw_front(axes: Axes, summary: Summary, finalists: pd.DataFrame) -> None:
    front = finalists[finalists["on_front"]].sort_values("ms")
    axes.step(front["ms"], front["error"], where="post", color="0.35", lw=1.2, zorder=3, label="front by validation")
    ms, low, high = zip(*((step.ms_per_frame, step.low, step.high) for step in summary.front.attainment), strict=True)
    label = "front, 8 of 10 draws of a seed each"
    axes.fill_between(ms, low, high, step="post", color="0.5", alpha=0.2, lw=0, label=label)


def _draw_finalist(axes: Axes, row: Any) -> None:
    """Draw a finalist with its intervals, given its row of `speed_accuracy_table`."""
    marker, size = _MARKERS[row.group]
    has_interval = not np.isnan(row.error_low)
    high = end_of_bar(row.error, row.error_low, row.error_high)
    axes.errorbar(
        row.ms,
        row.error,
        xerr=[[max(row.ms - row.ms_low, 0)], [max(row.ms_high - row.ms, 0)]],
        yerr=[[max(row.error - row.error_low, 0)], [max(high - row.error, 0)]] if has_interval else None,
        fmt=marker,
        markersize=size,
        color=MARKED[row.group],
        markeredgecolor="white",
        ecolor=MARKED[row.group],
        capsize=3,
        zorder=5,
    )


def _draw_solvers(axes: Axes, solvers: pd.DataFrame) -> None:
    """Draw the solver and coarser ones on a line, each with its name; those with slow sound on a dotted line."""
    for (group, series), line in zip(solvers.groupby("group", sort=False), ("-P", ":P"), strict=False):
        axes.plot(series["ms"], series["error"], line, color=SOLVER_COLOR, markersize=8, lw=0.8, zorder=4, label=group)
    for row in solvers.itertuples():
        axes.annotate(
            row.name,
            (row.ms, row.error),
            xytext=(6, 6),
            textcoords="offset points",
            fontsize=7.5,
            color=SOLVER_COLOR,
        )


def _draw_analytic(axes: Axes, analytic: pd.DataFrame) -> None:
    for row in analytic.itertuples():
        edge = axes.get_ylim()[0]
        axes.plot(row.ms, edge, "^", color=ANALYTIC_COLOR, markersize=10, clip_on=False, zorder=6)
        axes.annotate(
            f"{ANALYTIC} (error 0)",
            (row.ms, edge),
            xytext=(9, 6),
            textcoords="offset points",
            fontsize=8,
            color=ANALYTIC_COLOR,
        )


def _name_in_margin(axes: Axes, finalists: pd.DataFrame) -> None:
    """Names at the right, in the order of the errors, so that no two of them overlap."""
    low, high = np.log10(axes.get_ylim())
    heights = spread((np.log10(finalists["error"]) - low) / (high - low), gap=0.98 / max(11, len(finalists)))
    for row, height in zip(finalists.itertuples(), heights, strict=True):
        mark = "" if row.group in ("finalist", row.name) else f" ({row.group})"
        axes.annotate(
            f"{row.name}{mark}\n{row.error:.3g} · {row.ms:.3g} ms · {row.num_parameters:,.0f} parameters",
            (row.ms, row.error),
            xytext=(1.02, height),
            textcoords="axes fraction",
            va="center",
            fontsize=7.5,
            color=MARKED[row.group],
            arrowprops={"arrowstyle": "-", "color": "0.75", "lw": 0.7, "shrinkB": 5},
            annotation_clip=False,
        )


def spread(wanted: pd.Series, gap: float) -> list[float]:
    """Heights in descending order from 1 to 0, at least `gap` apart, near the wanted ones (descending)."""
    heights: list[float] = []
    for height in wanted:
        heights.append(min(height, heights[-1] - gap) if heights else min(height, 1.0))
    floor = 0.0
    for number in reversed(range(len(heights))):
        heights[number] = max(heights[number], floor)
        floor = heights[number] + gap
    return heights
