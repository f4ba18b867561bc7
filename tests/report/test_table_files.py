"""Tables of a run as files: what is read back is what the tables say."""

import json
import shutil

import pandas as pd
import pytest
from outcomes import assert_one_clear_line
from summaries import SAMPLE

from cconv.errors import ConfigError
from cconv.report import table_files
from cconv.report.table_files import OF_RUN, OF_SUMMARY, run_tables, write_tables
from cconv.study.records.run_folder import RunFolder


@pytest.fixture(scope="module")
def tables():
    return run_tables(RunFolder(SAMPLE))


def test_a_finished_run_has_every_table_that_is_not_empty(tables):
    assert {*OF_RUN, *OF_SUMMARY} - set(tables) == {"importance"}  # too few trials beat predicting the mean


def test_what_is_read_back_is_what_was_written(tables, tmp_path):
    pytest.importorskip("pyarrow")
    written = write_tables(RunFolder(SAMPLE), tmp_path / "tables")
    assert {path.name for path in written} == {path.name for path in (tmp_path / "tables").iterdir()}
    assert len(written) == 2 * len(tables)
    for name, table in tables.items():
        for read in (
            pd.read_csv(tmp_path / "tables" / f"{name}.csv"),
            pd.read_parquet(tmp_path / "tables" / f"{name}.parquet"),
        ):
            assert list(read.columns) == list(table.columns)
            assert len(read) == len(table)
            for column in table.select_dtypes("number"):
                assert read[column].astype(float).to_numpy() == pytest.approx(
                    table[column].astype(float).to_numpy(), nan_ok=True
                )


def test_without_pyarrow_there_is_only_csv(tmp_path, monkeypatch):
    monkeypatch.setattr(table_files, "find_spec", lambda name: None)
    written = write_tables(RunFolder(SAMPLE), tmp_path / "tables")
    assert {path.suffix for path in written} == {".csv"}


def test_a_folder_that_holds_something_is_not_replaced_unless_it_holds_tables(tmp_path):
    folder = tmp_path / "tables"
    folder.mkdir()
    (folder / "trials.csv").write_text("old")
    with pytest.raises(ConfigError, match="not empty"):
        write_tables(RunFolder(SAMPLE), folder)
    assert (folder / "trials.csv").read_text() == "old"
    write_tables(RunFolder(SAMPLE), folder, overwrite=True)
    assert (folder / "trials.csv").read_text() != "old"
    (folder / "mine.txt").write_text("mine")
    with pytest.raises(ConfigError, match="other files"):
        write_tables(RunFolder(SAMPLE), folder, overwrite=True)


def test_the_report_writes_tables_of_a_run_that_has_not_finished(cconv, tmp_path):
    run = tmp_path / "run"
    shutil.copytree(SAMPLE, run)
    (run / "summary.json").unlink()
    for stage in json.loads((run / "study.json").read_text())["stages"]:
        if stage in ("select", "finalists"):
            (run / "stages" / f"{stage}.json").unlink()
    status, out, error = cconv("report", run, "--tables", tmp_path / "tables")
    assert (status, error) == (0, "")
    assert "files in" in out
    assert {path.stem for path in (tmp_path / "tables").iterdir()} == set(OF_RUN)
    assert_one_clear_line(cconv("report", run, "--tables", tmp_path / "tables"), "not empty")
