"""Stability of the finalists as a matrix of checks: what was measured, the limit, and who passes."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import pandas as pd


@dataclass(frozen=True)
class Cell:
    """One finalist's result in one check.

    Attributes:
        text: What was measured, or "–".
        passes: Whether it is within the limit; None where there is no limit or nothing was measured.
        value: What was measured, where it has a limit.
    """

    text: str
    passes: bool | None
    value: float | None = None


@dataclass(frozen=True)
class Check:
    """One check of all finalists.

    Attributes:
        label: What is checked.
        limit: What must not be exceeded; None for no limit.
        cells: One for each finalist, in the order of the summary.
    """

    label: str
    limit: float | None
    cells: list[Cell]


def verdict_matrix(summary: Mapping) -> list[Check]:
    """One row a check; empty for a run that measured no stability."""
    measured = [entry.stability.model_dump() for entry in summary.finalists]
    first = measured[0]
    limits = first["thresholds"]
    checks = [_overall(measured)]
    for regime, values in first["regimes"].items():
        label = f"regime {_words(regime)} ({100 * values['share']:.0f} % of the particles)"
        checks.append(_check(label, limits["regime_error"], measured, ("regimes", regime, "normalized_mse")))
    for frame in first["stress"]:
        checks.append(_check(f"frame {_words(frame)}", limits["stressed_error"], measured, ("stress", frame)))
    for state in first.get("still", {}):  # of tasks that predict a rate
        checks.append(_check(f"nothing changes: {_words(state)}", limits["still"], measured, ("still", state)))
    checks.append(_check("float32 from float64", limits["precision"], measured, ("precision",)))
    if first["density_rollout"]:
        keys = ("density_rollout", "largest")
        checks.append(_check("integrated density, deviation", limits["density"], measured, keys))
        checks.append(_first_outside(measured, first["density_rollout"]["frames"]))
    return checks


def verdicts_table(summary: Mapping) -> pd.DataFrame:
    """The matrix as a table of texts: one row a check, its limit, then a column for each finalist."""
    names = [entry.id for entry in summary.finalists]
    rows = [
        {"check": check.label, "limit": check.limit}
        | {name: cell.text for name, cell in zip(names, check.cells, strict=True)}
        for check in verdict_matrix(summary)
    ]
    return pd.DataFrame(rows, columns=["check", "limit", *names])


def failures_table(summary: Mapping) -> pd.DataFrame:
    """One row a check that a finalist failed, in words."""
    rows = [
        {"model": entry.id, "failure": failure} for entry in summary.finalists for failure in entry.stability.failures
    ]
    return pd.DataFrame(rows, columns=["model", "failure"])


def _overall(measured: Sequence[Mapping]) -> Check:
    words = {True: "yes", False: "no", None: "–"}
    verdicts = [stability.get("stable") for stability in measured]
    return Check("passes every check", None, [Cell(words[verdict], verdict) for verdict in verdicts])


def _check(label: str, limit: float, measured: Sequence[Mapping], keys: tuple[str, ...]) -> Check:
    def cell(value: float | None) -> Cell:
        return Cell("–", None) if value is None else Cell(f"{value:.3g}", value <= limit, value)

    return Check(label, limit, _cells(measured, keys, cell))


def _first_outside(measured: Sequence[Mapping], frames: int) -> Check:
    def cell(rollout: Mapping | None) -> Cell:
        if rollout is None:
            return Cell("–", None)
        first = rollout["first_frame_outside"]
        return Cell("never" if first is None else str(first), None)

    return Check(f"first frame outside, of {frames}", None, _cells(measured, ("density_rollout",), cell))


def _cells(measured: Sequence[Mapping], keys: tuple[str, ...], cell: Callable) -> list[Cell]:
    values = []
    for value in measured:
        for key in keys:
            value = None if value is None else value.get(key)
        values.append(cell(value))
    return values


def _words(name: str) -> str:
    return name.replace("_", " ")
