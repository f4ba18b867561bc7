"""Stability of the finalists as a matrix of findings: what was measured, the limit, and who passes."""

from collections.abc import Mapping
from dataclasses import dataclass

import pandas as pd

ALL = "all"  # stands in the place of a check for the row that sums all up


@dataclass(frozen=True)
class Cell:
    """What a check found in one finalist.

    Attributes:
        text: What was measured, or "–".
        passes: Whether it is within the limit; None where nothing was measured.
        value: What was measured, where it has a limit.
        detail: What else the check says of it.
    """

    text: str
    passes: bool | None = None
    value: float | None = None
    detail: str = ""


@dataclass(frozen=True)
class Row:
    """What a check found in all finalists under one label.

    Attributes:
        check: Name of the check.
        label: What was looked at.
        limit: What must not be exceeded; None for no limit.
        cells: One for each finalist, in the order of the summary.
    """

    check: str
    label: str
    limit: float | None
    cells: list[Cell]


def verdict_matrix(summary: Mapping) -> list[Row]:
    """One row a finding, check after check, below one that sums all up; empty for a run that measured no stability."""
    measured = [entry["stability"] for entry in summary["finalists"]]
    found = [{(each["check"], each["label"]): each for each in (one or {}).get("findings", [])} for one in measured]
    first = next((findings for findings in found if findings), None)
    if first is None:
        return []
    rows = [Row(ALL, "passes every check", None, [_verdict(stability) for stability in measured])]
    for key, finding in first.items():
        cells = [_cell(findings.get(key)) for findings in found]
        rows.append(Row(finding["check"], finding["label"].replace("_", " "), finding["limit"], cells))
    return rows


def verdicts_table(summary: Mapping) -> pd.DataFrame:
    """The matrix as a table of texts: check, label and limit, then a column for each finalist."""
    names = [entry["id"] for entry in summary["finalists"]]
    rows = [
        {"check": row.check, "label": row.label, "limit": row.limit}
        | {name: cell.text for name, cell in zip(names, row.cells, strict=True)}
        for row in verdict_matrix(summary)
    ]
    return pd.DataFrame(rows, columns=["check", "label", "limit", *names])


def checks_table(summary: Mapping) -> pd.DataFrame:
    """One row a check of stability: its name and what it looks at."""
    return pd.DataFrame(summary["checks"].items(), columns=["check", "what it looks at"])


def failures_table(summary: Mapping) -> pd.DataFrame:
    """One row a finding beyond its limit, in words, with the finalist that it is of."""
    rows = [
        {"model": entry["id"], "failure": failure}
        for entry in summary["finalists"]
        if entry["stability"]
        for failure in entry["stability"]["failures"]
    ]
    return pd.DataFrame(rows, columns=["model", "failure"])


def _verdict(stability: Mapping | None) -> Cell:
    return Cell("–") if stability is None else Cell("yes" if stability["stable"] else "no", stability["stable"])


def _cell(finding: Mapping | None) -> Cell:
    if finding is None:
        return Cell("–")
    value = finding["value"]
    return Cell(f"{value:.3g}", value <= finding["limit"], value, finding["detail"])
