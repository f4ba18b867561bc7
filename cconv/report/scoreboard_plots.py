"""The scoreboard as a chart: error against time per frame of the same networks, scene by scene."""

import math
import textwrap
from itertools import chain, cycle
from typing import Any

import pandas as pd
import seaborn as sns
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.typing import ColorType

from cconv.report.colors import MEAN_COLOR, PUBLISHED_COLOR, SOLVER_COLOR
from cconv.report.plots import label_few_decades, new_panels
from cconv.report.published import CHECKPOINTS
from cconv.report.scoreboard import OURS
from cconv.report.tables import MEAN_PREDICTOR, SOLVER, end_of_bar

WIDEST_NAME = 38  # characters of a line of the legend
_MARKERS = "oDs^vP*X"
_DASHES = {"GNS": ":", "SEGNN": "-."}  # of published networks with checkpoints


def scoreboard_chart(scores: pd.DataFrame) -> Figure:
    """Error against time per frame, log axes, a panel for each data set; a network looks the same in all of them.

    Bars are 95 % intervals over trainings, where there are any; one that ends at its point has no upper end. Grey lines
    are the errors of published checkpoints in rollouts as long, which have no time on a CPU. The dashed line is
    predicting the mean.

    Args:
        scores: A table of `scores_table`, not empty.
    """
    scenes = list(scores.groupby("data", sort=False))
    figure, panels = new_panels(max(6.0, 4.2 * len(scenes)), 5.0, columns=len(scenes))
    looks = _looks(scores)
    for axes, (data, rows) in zip(panels, scenes, strict=True):
        _draw_scene(axes, rows, looks)
        axes.set_title(str(data), fontsize=10, parse_math=False)
        axes.set(xscale="log", yscale="log", xlabel="time per frame on a CPU [ms]")
        label_few_decades(axes.xaxis)
        axes.set_ylabel(f"MSE{rows['horizon'].iloc[0]} [length²]")
    figure.suptitle("Networks of steps, scene by scene")
    handles, labels = zip(*(axes.get_legend_handles_labels() for axes in panels), strict=True)
    labelled = dict(zip(chain(*labels), chain(*handles), strict=True))
    figure.legend(labelled.values(), labelled.keys(), loc="outside lower center", ncols=4, fontsize=8, frameon=False)
    return figure


def _looks(scores: pd.DataFrame) -> dict[str, list]:
    """Colour and marker of each measured network."""
    measured = scores[(scores["source"] == OURS) & ~scores["network"].isin([SOLVER, MEAN_PREDICTOR])]
    names = list(measured["network"].unique())
    colors = sns.color_palette("colorblind", len(names))
    return {name: look for name, *look in zip(names, colors, cycle(_MARKERS), strict=False)}  # markers are endless


def _draw_scene(axes: Axes, rows: pd.DataFrame, looks: dict[str, list]) -> None:
    for row in rows[rows["error"].notna()].itertuples():
        if row.network in looks and row.source == OURS:
            _draw_network(axes, row, *looks[row.network])
        elif row.network == SOLVER:
            axes.plot(row.ms, row.error, "P", color=SOLVER_COLOR, ms=9, label=SOLVER)
        elif row.network == MEAN_PREDICTOR:
            axes.axhline(row.error, color=MEAN_COLOR, lw=1.2, ls="--", label=MEAN_PREDICTOR)
        elif row.source == CHECKPOINTS:
            label, dashes = f"{row.network}, published", _DASHES[row.network.partition("-")[0]]
            axes.axhline(row.error, color=PUBLISHED_COLOR, lw=1.2, ls=dashes, zorder=1, label=label)


def _draw_network(axes: Axes, row: Any, color: ColorType, marker: str) -> None:
    has_interval = not math.isnan(row.ci95_low)
    high = end_of_bar(row.error, row.ci95_low, row.ci95_high)
    axes.errorbar(
        row.ms,
        row.error,
        yerr=[[row.error - row.ci95_low], [high - row.error]] if has_interval else None,
        fmt=marker,
        color=color,
        ms=8,
        mec="white",
        capsize=3,
        label=textwrap.fill(row.network, WIDEST_NAME),
    )
