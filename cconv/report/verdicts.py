"""Stability of the finalists as a matrix of findings: what was measured, the limit, and who passes."""

from dataclasses import dataclass

import pandas as pd

from cconv.study.records.summary import Finding, Summary

ALL = "all"  # stands in the place of a check for the row that sums all up


@dataclass(frozen=True)
class Row:
    """What a check found in all finalists under one label.

    Attributes:
        check: Name of the check.
        label: What was looked at.
        limit: What must not be exceeded.
        cells: One finding for each finalist, in the order of the summary.
    """

    check: str
    label: str
    limit: float
    cells: tuple[Finding, ...]


def verdict_matrix(summary: Summary) -> list[Row]:
    """One row a finding, check after check."""
    by_label = zip(*(entry.stability.findings for entry in summary.finalists), strict=True)
    return [Row(cells[0].check, cells[0].label.replace("_", " "), cells[0].limit, cells) for cells in by_label]


def verdicts_table(summary: Summary) -> pd.DataFrame:
    """The matrix as a table of texts: check, label and limit, then a column for each finalist.

    Its first row says which finalists pass every check.
    """
    names = [entry.id for entry in summary.finalists]
    stable = {entry.id: "yes" if entry.stability.stable else "no" for entry in summary.finalists}
    rows = [{"check": ALL, "label": "passes every check", "limit": None} | stable] + [
        {"check": row.check, "label": row.label, "limit": row.limit}
        | {name: f"{cell.value:.3g}" for name, cell in zip(names, row.cells, strict=True)}
        for row in verdict_matrix(summary)
    ]
    return pd.DataFrame(rows, columns=["check", "label", "limit", *names])


def checks_table(summary: Summary) -> pd.DataFrame:
    """One row a check of stability: its name and what it looks at."""
    return pd.DataFrame(summary.checks.items(), columns=["check", "what it looks at"])


def failures_table(summary: Summary) -> pd.DataFrame:
    """One row a finding beyond its limit, in words, with the finalist that it is of."""
    rows = [
        {"model": entry.id, "failure": failure} for entry in summary.finalists for failure in entry.stability.failures
    ]
    return pd.DataFrame(rows, columns=["model", "failure"])
