"""Charts of a study. Each function returns a matplotlib figure of its own; showing or saving it is the caller's."""

from collections.abc import Mapping

import pandas as pd
import seaborn as sns
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from cconv.report.tables import finalists_table

_BASELINE, _FINALIST, _RECOMMENDED = "#c44e52", "#4c72b0", "#55a868"
_STAGES = {"closed_form": "#8172b3", "initialization": "0.6", "random": "#4c72b0", "adaptive": "#dd8452"}


def speed_accuracy_chart(summary: Mapping) -> Figure:
    """Test error against time per frame, log axes; baseline marked, front drawn.

    Vertical bars are 95 % intervals over seeds and test units, horizontal bars the quartiles of the timing.
    """
    table = finalists_table(summary).set_index("model")
    recommended = summary["recommended"]["id"]
    figure, axes = _figure(7.5, 5)
    for number, (name, row) in enumerate(table.iterrows()):
        color = {summary["baseline"]: _BASELINE, recommended: _RECOMMENDED}.get(name, _FINALIST)
        error, ms = row["normalized_mse"], row["ms_per_frame"]
        axes.errorbar(
            ms,
            error,
            xerr=[[max(ms - row["ms_low"], 0)], [max(row["ms_high"] - ms, 0)]],
            yerr=[[max(error - row["ci95_low"], 0)], [max(row["ci95_high"] - error, 0)]],
            fmt="s" if name == summary["baseline"] else "*" if name == recommended else "o",
            markersize=15 if name == recommended else 9,
            color=color,
            capsize=3,
            zorder=3,
        )
        label = f"{name} (recommended)" if name == recommended else name
        axes.annotate(
            f"{label}\n{row['num_parameters']:,.0f} parameters",
            (ms, error),
            xytext=(10, 6) if number % 2 == 0 else (10, -24),
            textcoords="offset points",
            fontsize=8,
            color=color,
        )
    front = table.loc[summary["pareto_front"]]
    axes.step(front["ms_per_frame"], front["normalized_mse"], where="post", color="0.6", zorder=1, label="front")
    axes.set(xscale="log", yscale="log", xlabel="time per frame [ms]", ylabel="test error (normalized MSE)")
    axes.xaxis.set_major_formatter("{x:g}")
    axes.xaxis.set_minor_formatter("{x:g}")
    axes.margins(x=0.35, y=0.25)
    threads = summary["finalists"][0]["cost"]["threads"]
    axes.set_title(f"{summary['study']}: error against cost ({threads} thread{'s' if threads > 1 else ''})")
    axes.legend(loc="best")
    return figure


def learning_curves_chart(curves: pd.DataFrame, baseline: str = "baseline") -> Figure:
    """Validation error against gradient updates, one line a search trial, and one for each retraining beside them."""
    figure, (search, finals) = _figure(11, 4.2, columns=2)
    trials, retrained = curves[curves["stage"] != "finalists"], curves[curves["stage"] == "finalists"]
    for (_, stage), curve in trials.groupby(["name", "stage"]):
        search.plot(
            curve["updates"],
            curve["valid_normalized_mse"],
            color=_STAGES.get(stage, "0.5"),
            alpha=0.6,
            marker=".",
            lw=1,
        )
    for stage, color in _STAGES.items():
        if stage in set(trials["stage"]):
            search.plot([], [], color=color, label=f"{stage} search")
    challengers = sorted(set(retrained["name"]) - {baseline})
    colors = {baseline: _BASELINE} | dict(zip(challengers, sns.color_palette("deep", len(challengers)), strict=True))
    for name, lines in retrained.groupby("name"):
        for number, (_, curve) in enumerate(lines.groupby("seed")):
            style = {"color": colors[name], "label": None if number else name, "lw": 1.2}
            finals.plot(curve["updates"], curve["valid_normalized_mse"], **style)
    for axes, title in ((search, "search"), (finals, "finalists, one line a seed")):
        axes.set(yscale="log", xlabel="gradient updates", ylabel="validation error (normalized MSE)", title=title)
        if axes.get_legend_handles_labels()[0]:
            axes.legend(fontsize=8)
    return figure


def best_so_far_chart(trials: pd.DataFrame) -> Figure:
    """Smallest validation error found against trials begun, and each trial's error by outcome."""
    figure, axes = _figure(7.5, 4)
    order = range(1, len(trials) + 1)
    sns.scatterplot(
        x=list(order), y=trials["valid_normalized_mse"], hue=trials["outcome"], style=trials["stage"], ax=axes, zorder=3
    )
    complete = trials["valid_normalized_mse"].where(trials["outcome"] == "completed")
    axes.step(order, complete.cummin().ffill(), where="post", color="0.5", label="best of the full budget")
    axes.set(yscale="log", xlabel="trial", ylabel="last validation error (normalized MSE)", title="search")
    axes.legend(fontsize=8)
    return figure


def _figure(width: float, height: float, columns: int = 1) -> tuple[Figure, Axes]:
    with sns.axes_style("whitegrid"):
        figure = Figure(figsize=(width, height), layout="constrained")
        return figure, figure.subplots(1, columns)
