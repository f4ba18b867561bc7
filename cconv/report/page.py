"""The report of a study: one HTML file that opens without a network."""

import base64
import io
from collections.abc import Callable, Mapping
from pathlib import Path

import pandas as pd
from jinja2 import Environment, PackageLoader, select_autoescape
from matplotlib.figure import Figure

from cconv.files import write_text
from cconv.report.decidable import decidable
from cconv.report.fields import error_distribution_chart, fields_chart, filters_chart, read_explanations
from cconv.report.importance_plots import importance_chart, partial_dependence_chart
from cconv.report.interactive import interactive_html
from cconv.report.plots import (
    ablation_chart,
    best_so_far_chart,
    budget_chart,
    growth_chart,
    learning_curves_chart,
    rung_audit_chart,
    strategies_chart,
)
from cconv.report.tables import MEAN_PREDICTOR, curves_table, finalists_table, importance_table, trials_table
from cconv.report.verdicts import verdict_matrix
from cconv.study.records.run_folder import RunFolder

# Figures of what a summary may hold, by the key that it holds it under.
_CHARTS: dict[str, Callable[[Mapping], Figure]] = {
    "growth": growth_chart,
    "references": strategies_chart,
    "rung_audit": rung_audit_chart,
    "partial_dependence": lambda summary: partial_dependence_chart(summary["partial_dependence"]),
}


def write_report(run: RunFolder) -> Path:
    """Write `report.html` into a run folder, also of a run that was interrupted.

    Returns:
        Path of the report.
    """
    path = run.path / "report.html"
    write_text(path, render_report(run))
    return path


def render_report(run: RunFolder) -> str:
    """HTML of the report, charts included."""
    environment = Environment(
        loader=PackageLoader("cconv.report"), autoescape=select_autoescape(["html.j2"]), trim_blocks=True
    )
    environment.filters |= {"number": _number, "duration": _duration}
    summary = _read_if_there(run, "summary.json")
    return environment.get_template("report.html.j2").render(
        study=run.read("study.json"),
        space=run.read("space.json"),
        state=run.read("state.json"),
        environment=_read_if_there(run, "environment.json"),
        summary=summary,
        **_search_parts(run, summary),
        **(_finished_parts(run, summary) if summary else {}),
    )


def _search_parts(run: RunFolder, summary: Mapping | None) -> dict:
    """What the trials show, also of a run that is not finished, for which the mean predictor is not known yet."""
    mean = {"mean_predictor": summary["mean_predictor"]["valid"] if summary else None}
    trials, curves = trials_table(run), curves_table(run)
    searched = not trials.empty and bool(trials["valid_error"].notna().any())
    return {
        "curves_chart": _picture(learning_curves_chart(curves, **mean)) if searched else None,
        "search_chart": _picture(best_so_far_chart(trials, **mean)) if searched else None,
        "trials": "" if trials.empty else _html(_with_mean_predictor(trials, **mean)),
    }


def _with_mean_predictor(trials: pd.DataFrame, mean_predictor: float | None) -> pd.DataFrame:
    """Trials by error, with a row of the mean predictor in its place, where it is known."""
    table = trials.astype(object)  # a row with gaps would turn whole numbers into fractions
    if mean_predictor is not None:
        table.loc[len(table), ["trial", "valid_error"]] = [MEAN_PREDICTOR, mean_predictor]
    return table.sort_values("valid_error")


def _finished_parts(run: RunFolder, summary: Mapping) -> dict:
    return {
        "reason": _lead(summary["recommended"]["reason"]),
        "comparison": _comparison(summary),
        "chart": interactive_html(summary),
        "charts": {name: _picture(draw(summary)) for name, draw in _CHARTS.items() if summary.get(name)}
        | {"budget": _picture(budget_chart(curves_table(run), [entry["id"] for entry in summary["finalists"]]))}
        | _importance_chart(summary)
        | ({"ablation": _picture(ablation_chart(summary))} if summary.get("ablation", {}).get("path") else {}),
        "decidable": decidable(summary),
        "importances": importance_table(summary).to_dict("records"),
        "finalists": _finalists_rows(summary),
        "stability": verdict_matrix(summary),
        "explained": _explained(run, summary),
    }


def _importance_chart(summary: Mapping) -> dict[str, str]:
    """The chart of importances, if there are any: at some rungs too little is known for bars."""
    entries = summary.get("importance", [])
    return {"importance": _picture(importance_chart(entries))} if any(entry["parameters"] for entry in entries) else {}


def _lead(text: str) -> tuple[str, str]:
    """The first sentence and the others."""
    first, stop, others = text.partition(". ")
    return first + stop.strip(), others


def _comparison(summary: Mapping) -> dict:
    """The recommended model beside the baseline, as ratios where the baseline finished."""
    entries = {entry["id"]: entry for entry in summary["finalists"]}
    baseline, chosen = entries.get(summary["baseline"]), entries[summary["recommended"]["id"]]
    if baseline is None:
        return {"baseline": None, "chosen": chosen}
    return {
        "baseline": baseline,
        "chosen": chosen,
        "error_ratio": baseline["test"]["normalized_mse"] / chosen["test"]["normalized_mse"],
        "speed_ratio": baseline["cost"]["ms_per_frame"] / chosen["cost"]["ms_per_frame"],
        "size_ratio": baseline["num_parameters"] / chosen["num_parameters"],
    }


def _finalists_rows(summary: Mapping) -> list[dict]:
    """Rows of the tables of finalists, most accurate first; each with its whole entry in the summary.

    The rows of the mean predictor and of analytic SPH are among them, without an entry.
    """
    front = set(summary["pareto_front"])
    entries = {entry["id"]: entry for entry in summary["finalists"]}
    rows = finalists_table(summary).to_dict("records")
    return [row | {"on_front": row["model"] in front, "entry": entries.get(row["model"])} for row in rows]


def _explained(run: RunFolder, summary: Mapping) -> dict | None:
    """Charts of what the recommended model and the baseline have learned, where they were explained."""
    explanations = read_explanations(run)
    best, baseline = summary["recommended"]["id"], summary["baseline"]
    names = [name for name in dict.fromkeys((best, baseline)) if name in explanations]
    if not names:
        return None
    return {
        "distribution": _picture(error_distribution_chart(explanations, baseline, best)),
        "models": {
            name: {
                "filters": _picture(filters_chart(explanations[name])),
                "fields": _picture(fields_chart(explanations[name])),
                "unexplained": float(explanations[name]["unexplained"]),
                "is_combined": bool(explanations[name]["is_combined"]),
            }
            for name in names
        },
    }


def _read_if_there(run: RunFolder, name: str) -> dict | None:
    return run.read(name) if (run.path / name).is_file() else None


def _number(value: float | int | bool | str | None, digits: int = 3) -> str:
    """A value for a reader: whole numbers in full, others with so many digits, "–" for none."""
    if value is None or value != value:  # nan
        return "–"
    if isinstance(value, bool | str):
        return {True: "yes", False: "no"}.get(value, str(value))
    if isinstance(value, int):
        return f"{value:,}"
    rounded = float(f"{value:.{digits}g}")
    return f"{rounded:,.0f}" if 1000 <= abs(rounded) < 1e6 else f"{rounded:.{digits}g}"


def _duration(seconds: float) -> str:
    """Seconds in the unit that a reader expects."""
    for unit, length in (("hours", 3600), ("minutes", 60)):
        if seconds >= 2 * length:
            return f"{seconds / length:.1f} {unit}"
    return f"{seconds:.3g} seconds"


def _html(table: pd.DataFrame) -> str:
    return table.to_html(index=False, border=0, float_format=lambda value: f"{value:.4g}", na_rep="–")


def _picture(figure: Figure) -> str:
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=110)
    return base64.b64encode(buffer.getvalue()).decode()
