"""The report of a study: one HTML file that opens without a network."""

import base64
import io
import os
from pathlib import Path

import pandas as pd
from jinja2 import Environment, PackageLoader, select_autoescape
from matplotlib.figure import Figure

from cconv.report.plots import best_so_far_chart, learning_curves_chart, speed_accuracy_chart
from cconv.report.tables import curves_table, finalists_table, stability_rows, trials_table
from cconv.study.records import RunFolder


def write_report(run: RunFolder) -> Path:
    """Write `report.html` into a run folder, also of a run that was interrupted.

    Returns:
        Path of the report.
    """
    path = run.path / "report.html"
    temporary = path.with_suffix(".html.part")
    temporary.write_text(render_report(run))
    os.replace(temporary, path)
    return path


def render_report(run: RunFolder) -> str:
    """HTML of the report, pictures included."""
    environment = Environment(loader=PackageLoader("cconv.report"), autoescape=select_autoescape())
    finished = (run.path / "summary.json").is_file()
    summary = run.read("summary.json") if finished else None
    trials, curves = trials_table(run), curves_table(run)
    searched = not trials.empty and bool(trials["valid_normalized_mse"].notna().any())
    return environment.get_template("report.html.j2").render(
        study=run.read("study.json"),
        space=run.read("space.json"),
        state=run.read("state.json"),
        environment=run.read("environment.json") if (run.path / "environment.json").is_file() else None,
        summary=summary,
        comparison=_comparison(summary) if finished else None,
        front_chart=_picture(speed_accuracy_chart(summary)) if finished else None,
        curves_chart=_picture(learning_curves_chart(curves)) if searched else None,
        search_chart=_picture(best_so_far_chart(trials)) if searched else None,
        finalists=_finalists_rows(summary) if finished else [],
        stability=stability_rows(summary) if finished else [],
        trials=_html(trials.sort_values("valid_normalized_mse")) if not trials.empty else "",
    )


def _comparison(summary: dict) -> dict:
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


def _finalists_rows(summary: dict) -> list[dict]:
    front = set(summary["pareto_front"])
    rows = finalists_table(summary).to_dict("records")
    hyperparameters = {entry["id"]: entry["config"]["parameters"] for entry in summary["finalists"]}
    return [row | {"on_front": row["model"] in front, "settings": hyperparameters[row["model"]]} for row in rows]


def _html(table: pd.DataFrame) -> str:
    return table.to_html(index=False, border=0, float_format=lambda value: f"{value:.4g}", na_rep="–")


def _picture(figure: Figure) -> str:
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=130)
    return base64.b64encode(buffer.getvalue()).decode()
