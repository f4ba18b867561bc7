"""The chart of a study to hover over: error against time per frame, with the hyperparameters of every point."""

import math
from typing import Any

import pandas as pd
import plotly.graph_objects as go
import plotly.io

from cconv.report.colors import ANALYTIC_COLOR, MARKED, MEAN_COLOR, PUBLISHED_COLOR, SOLVER_COLOR, stage_colors
from cconv.report.published import published_errors
from cconv.report.speed_accuracy import error_range
from cconv.report.tables import MEAN_PREDICTOR, error_interval, speed_accuracy_table
from cconv.study.records.summary import Front, Summary

_SYMBOLS = {"recommended": "star", "baseline": "square", "thesis's best": "diamond", "finalist": "circle"}


def interactive_chart(summary: Summary) -> go.Figure:
    """Error against time per frame, log axes: finalists with intervals, search, front, analytic SPH, solvers.

    Hovering over a point shows its name, error, interval, time, parameters and all hyperparameters.
    """
    points = speed_accuracy_table(summary)
    kinds = ("search", "finalist", "analytic", "solver")
    search, finalists, analytic, solvers = (points[points["kind"] == kind] for kind in kinds)
    trivial, published = summary.mean_predictor.test, published_errors(summary)
    low, high = error_range(points, trivial, *published.values())
    figure = go.Figure()
    colors = stage_colors(list(search["group"].unique()))
    for stage, trials in search.groupby("group", sort=False):
        figure.add_trace(_search_trace(stage, trials, colors[stage]))
    figure.add_traces(_attainment_traces(summary.front))
    figure.add_trace(_front_trace(finalists))
    ends = [points["ms"].min(), points["ms"].max()]
    figure.add_trace(_line_trace(f"{MEAN_PREDICTOR}: {trivial:.3g}", trivial, ends, MEAN_COLOR, "dash"))
    for name, error in published.items():
        figure.add_trace(_line_trace(f"{name}, published: {error:.3g}", error, ends, PUBLISHED_COLOR, "dot"))
    for group in _SYMBOLS:
        members = finalists[finalists["group"] == group]
        if not members.empty:
            figure.add_trace(_finalists_trace(group, members))
    if not analytic.empty:
        figure.add_trace(_analytic_trace(analytic, low))
    for group, series in solvers.groupby("group", sort=False):
        figure.add_trace(_solvers_trace(str(group), series))
    figure.update_xaxes(title="time per frame [ms]", type="log")
    figure.update_yaxes(title=f"error ({summary.task.error})", type="log", dtick=1, exponentformat="power")
    figure.update_yaxes(range=[math.log10(low), math.log10(high)])
    figure.update_layout(template="plotly_white", height=640, hovermode="closest", margin={"t": 60, "r": 20})
    figure.update_layout(title={"text": "error and time per frame of each model", "font": {"size": 15}})
    figure.update_layout(legend={"orientation": "h", "y": -0.15}, hoverlabel={"align": "left"})
    return figure


def interactive_html(summary: Summary) -> str:
    """The chart as a piece of HTML that needs no network: plotly's program is part of it."""
    return plotly.io.to_html(
        interactive_chart(summary),
        full_html=False,
        include_plotlyjs=True,
        div_id="speed-accuracy",
        config={"displaylogo": False, "responsive": True},
    )


def _search_trace(stage: str, trials: pd.DataFrame, color: str) -> go.Scatter:
    symbols = ["circle" if outcome == "completed" else "circle-open" for outcome in trials["outcome"]]
    return go.Scatter(
        x=trials["ms"],
        y=trials["error"],
        mode="markers",
        name=f"{stage} (search)",
        marker={"color": color, "size": 6, "opacity": 0.55, "symbol": symbols},
        **_hover(trials),
    )


def _attainment_traces(front: Front) -> list[go.Scatter]:
    table = pd.DataFrame(map(dict, front.attainment))
    style = {"x": table["ms_per_frame"], "mode": "lines", "hoverinfo": "skip", "legendgroup": "band"}
    edge = {"color": "rgba(120,120,120,0.4)", "width": 0.5, "shape": "hv"}
    return [
        go.Scatter(y=table["low"], line=edge, showlegend=False, **style),
        go.Scatter(y=table["high"], line=edge, fill="tonexty", fillcolor="rgba(120,120,120,0.18)",
                   name="front, 8 of 10 draws of a seed each", **style),
        go.Scatter(y=table["median"], line={"color": "#999", "dash": "dot", "shape": "hv"},
                   name="front, median of these draws", **style | {"legendgroup": None}),
    ]  # fmt: skip


def _front_trace(finalists: pd.DataFrame) -> go.Scatter:
    front = finalists[finalists["on_front"]].sort_values("ms")
    line = {"color": "#555", "width": 1.5, "shape": "hv"}
    return go.Scatter(
        x=front["ms"], y=front["error"], mode="lines", line=line, name="front by validation", hoverinfo="skip"
    )


def _line_trace(name: str, error: float, ends: list[float], color: str, dash: str) -> go.Scatter:
    """A line across the chart at an error that belongs to no time."""
    line = {"color": color, "width": 1.5, "dash": dash}
    return go.Scatter(x=ends, y=[error, error], mode="lines", line=line, name=name, hoverinfo="skip")


def _finalists_trace(group: str, members: pd.DataFrame) -> go.Scatter:
    def bars(value: str) -> dict:
        above, below = members[f"{value}_high"] - members[value], members[value] - members[f"{value}_low"]
        return {"type": "data", "array": above.clip(lower=0), "arrayminus": below.clip(lower=0), "width": 4}

    size = 19 if group == "recommended" else 12
    return go.Scatter(
        x=members["ms"],
        y=members["error"],
        error_x=bars("ms"),
        error_y=bars("error"),
        mode="markers",
        name=f"{group}s" if group == "finalist" else group,
        marker={"symbol": _SYMBOLS[group], "size": size, "color": MARKED[group]},
        marker_line={"color": "white", "width": 1},
        **_hover(members),
    )


def _analytic_trace(analytic: pd.DataFrame, edge: float) -> go.Scatter:
    text = [
        f"<b>{row.name}</b><br>error 0 by definition, drawn at the lower edge"
        f"<br>{row.ms:.3g} ms per frame ({row.ms_low:.3g} to {row.ms_high:.3g})"
        for row in analytic.itertuples(index=False)
    ]
    return go.Scatter(
        x=analytic["ms"], y=[edge] * len(analytic), mode="markers+text", name=analytic["name"].iloc[0],
        text=analytic["name"], textposition="top center", cliponaxis=False, hovertext=text, hoverinfo="text",
        marker={"symbol": "triangle-up", "size": 14, "color": ANALYTIC_COLOR}, showlegend=False,
    )  # fmt: skip


def _solvers_trace(name: str, solvers: pd.DataFrame) -> go.Scatter:
    text = [
        f"<b>{row.name}</b><br>error {row.error:.4g}"
        f"<br>{row.ms:.3g} ms per frame ({row.ms_low:.3g} to {row.ms_high:.3g})"
        for row in solvers.itertuples(index=False)
    ]
    return go.Scatter(
        x=solvers["ms"], y=solvers["error"], mode="lines+markers", name=name, hovertext=text, hoverinfo="text",
        marker={"symbol": "cross", "size": 12, "color": SOLVER_COLOR}, line={"color": SOLVER_COLOR, "width": 1},
    )  # fmt: skip


def _hover(points: pd.DataFrame) -> dict:
    return {"hovertext": [_description(row) for row in points.itertuples(index=False)], "hoverinfo": "text"}


def _description(row: Any) -> str:
    """What is shown of a point, given its row of `speed_accuracy_table`."""
    tested = row.kind == "finalist"
    error = f"{'test' if tested else 'validation'} error {row.error:.4g}"
    if tested and not math.isnan(row.error_low):
        error += f" (95 %: {error_interval(row.error_low, row.error_high)})"
    lines = [
        f"<b>{row.name}</b> – {row.group}{'' if row.outcome == 'completed' else f', {row.outcome}'}",
        error,
        f"{row.ms:.3g} ms per frame{'' if row.measured else ', estimated'}",
        f"{row.num_parameters:,.0f} parameters",
    ]
    settings = [f"{name} = {_short(value)}" for name, value in row.hyperparameters.items()]
    return "<br>".join([*lines, *settings])


def _short(value: object) -> str:
    return f"{value:.4g}" if isinstance(value, float) else str(value)
