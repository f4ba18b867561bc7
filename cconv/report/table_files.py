"""The tables of a run as files: CSV for every program, and Parquet, which keeps types, where pyarrow is installed."""

from importlib.util import find_spec
from pathlib import Path

import pandas as pd

from cconv.data.folders import whole_folder
from cconv.report.tables import (
    curves_table,
    finalists_table,
    growth_table,
    importance_table,
    rung_audit_table,
    speed_accuracy_table,
    strategies_table,
    trials_table,
)
from cconv.report.verdicts import failures_table, verdicts_table
from cconv.study.records.run_folder import RunFolder

OF_RUN = {"trials": trials_table, "curves": curves_table}
OF_SUMMARY = {
    "finalists": finalists_table,
    "speed_accuracy": lambda summary: speed_accuracy_table(summary).drop(columns="hyperparameters", errors="ignore"),
    "growth": growth_table,
    "strategies": strategies_table,
    "rung_audit": rung_audit_table,
    "importance": lambda summary: importance_table(summary.importance),
    "verdicts": verdicts_table,
    "failures": failures_table,
}


def run_tables(run: RunFolder) -> dict[str, pd.DataFrame]:
    """Make the tables of a run by their names; empty ones, and those of a study that has not finished, are left out.

    Trials hold the hyperparameters of each training of a search, which are left out of the points of the chart of speed
    and accuracy.

    Raises:
        DataError: If a record is damaged.
    """
    tables = {name: make(run) for name, make in OF_RUN.items()}
    if run.has_summary:
        summary = run.summary()
        tables |= {name: make(summary) for name, make in OF_SUMMARY.items()}
    return {name: table for name, table in tables.items() if len(table)}


def write_tables(run: RunFolder, folder: Path, overwrite: bool = False) -> list[Path]:
    """Write each table of a run to a folder, which appears whole or not at all, and list its files.

    Args:
        run: The run.
        folder: Folder to write.
        overwrite: Whether older tables in the folder may be replaced.

    Raises:
        ConfigError: If the folder exists and must not be replaced, or cannot be written.
        DataError: If a record is damaged.
    """
    tables, written = run_tables(run), []
    possible = [f"{name}.{ending}" for name in (*OF_RUN, *OF_SUMMARY) for ending in ("csv", "parquet")]
    with whole_folder(folder, possible, overwrite) as partial:
        for name, table in tables.items():
            table.to_csv(partial / f"{name}.csv", index=False)
            written.append(folder / f"{name}.csv")
            if find_spec("pyarrow") is not None:
                _of_one_type(table).to_parquet(partial / f"{name}.parquet", engine="pyarrow", index=False)
                written.append(folder / f"{name}.parquet")
    return written


def _of_one_type(table: pd.DataFrame) -> pd.DataFrame:
    """The table with columns of several types as text, as a column of Parquet has one type."""
    mixed = [name for name in table if table[name].dtype == object and table[name].dropna().map(type).nunique() > 1]
    return table.assign(**{name: table[name].map(str, na_action="ignore") for name in mixed})
