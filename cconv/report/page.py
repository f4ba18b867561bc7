"""The report of a study: one HTML file that opens without a network."""

import base64
import io
from pathlib import Path
from typing import cast

import pandas as pd
from jinja2 import Environment, PackageLoader, StrictUndefined, select_autoescape
from matplotlib.figure import Figure

from cconv.files import write_text
from cconv.report.sections import SECTIONS
from cconv.report.sections.section import Records
from cconv.report.tables import error_interval
from cconv.study.records.run_folder import RunFolder
from cconv.study.records.summary import Summary


def write_report(run: RunFolder) -> Path:
    """Write `report.html` into a run folder, also of a run that was interrupted.

    Returns:
        Path of the report.
    """
    path = run.path / "report.html"
    write_text(path, render_report(run))
    return path


def render_report(run: RunFolder) -> str:
    """HTML of the report, charts included: the sections that apply, one after the other."""
    pages, records = templates(), Records.read(run)
    summary = run.summary() if run.has_summary else None
    shown = [section for section in SECTIONS if section.applies(summary)]
    known = {"summary": summary, "records": records}
    bodies = {
        section.name: pages.get_template(f"sections/{section.name}.html.j2").render(
            **known,
            **section.draw(cast(Summary, summary), records),  # one that applies without a summary takes None
        )
        for section in shown
    }
    page = pages.get_template("report.html.j2")
    return page.render(**known, state=run.read("state.json"), sections=shown, bodies=bodies)


def templates() -> Environment:
    """Templates of pages, which escape what they are given, and the filters that they use."""
    environment = Environment(
        loader=PackageLoader("cconv.report"),
        autoescape=select_autoescape(["html.j2"]),
        trim_blocks=True,
        undefined=StrictUndefined,
    )
    environment.globals |= {"error_interval": error_interval}
    environment.filters |= {"number": _number, "duration": _duration, "table": _table, "png": _png}
    return environment


def _number(value: float | int | bool | str | None, digits: int = 3) -> str:
    """A value for a reader: whole numbers in full, others with so many digits, "–" for none."""
    if value is None or value != value:  # nan
        return "–"
    if isinstance(value, str):
        return value
    if isinstance(value, bool):
        return "yes" if value else "no"
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


def _table(table: pd.DataFrame) -> str:
    """A table in HTML; pandas escapes what stands in it."""
    return table.to_html(index=False, border=0, float_format=lambda value: f"{value:.4g}", na_rep="–")


def _png(figure: Figure) -> str:
    """A figure as a picture in base64."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=110)
    return base64.b64encode(buffer.getvalue()).decode()
