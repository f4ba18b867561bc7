import json
import re
import shutil
import subprocess
import sys

import pytest

from cconv.report.page import write_report
from cconv.report.plots import best_so_far_chart, learning_curves_chart, speed_accuracy_chart
from cconv.report.tables import curves_table, finalists_table, trials_table
from cconv.study.records import RunFolder


@pytest.fixture
def run(finished_run):
    return RunFolder.open(finished_run)


def test_trials_table_has_a_row_a_trial_and_its_hyperparameters(run):
    table = trials_table(run)
    assert list(table["trial"]) == [record.id for record in run.trials()]
    assert {"kernel_size", "message", "learning_rate", "outcome", "num_parameters"} <= set(table.columns)


def test_curves_table_has_a_row_an_evaluation(run):
    table = curves_table(run)
    records = [*run.trials(), *(record for records in run.retrainings().values() for record in records)]
    assert len(table) == sum(len(record.log) for record in records)
    assert (table["valid_normalized_mse"] > 0).all()


def test_finalists_table_is_sorted_by_error(run):
    table = finalists_table(run.read("summary.json"))
    assert table["normalized_mse"].is_monotonic_increasing
    assert (table["ci95_low"] <= table["normalized_mse"]).all()


def test_speed_accuracy_chart_has_log_axes_every_finalist_and_the_front(run):
    summary = run.read("summary.json")
    (axes,) = speed_accuracy_chart(summary).axes
    assert (axes.get_xscale(), axes.get_yscale()) == ("log", "log")
    labels = " ".join(text.get_text() for text in axes.texts)
    assert all(entry["id"] in labels for entry in summary["finalists"])
    assert "front" in axes.get_legend_handles_labels()[1]


def test_other_charts_show_the_trials(run):
    search, finals = learning_curves_chart(curves_table(run)).axes
    assert len(search.lines) >= len(run.trials())
    assert len(finals.lines) == sum(len(records) for records in run.retrainings().values())
    assert best_so_far_chart(trials_table(run)).axes[0].get_yscale() == "log"


def test_report_opens_without_a_network_and_states_the_figures(run):
    page = write_report(run).read_text()
    assert not re.findall(r"""(?:src|href)=["'](?!data:)""", page)
    assert page.count("data:image/png;base64,") == 3
    summary = run.read("summary.json")
    assert summary["recommended"]["reason"].split(" (")[0] in page
    for entry in summary["finalists"]:
        assert f"{entry['test']['normalized_mse']:.4g}" in page


def test_a_run_whose_baseline_failed_has_a_report_that_says_so(run, tmp_path):
    shutil.copytree(run.path, tmp_path / "lame")
    summary = run.read("summary.json")
    summary["finalists"] = [entry for entry in summary["finalists"] if entry["id"] != "baseline"]
    other = summary["finalists"][0]["id"]
    summary |= {"pareto_front": [other], "recommended": {"id": other, "reason": "alone"}}
    summary["failed_finalists"] = {"baseline": "seed_1 failed out of memory"}
    (tmp_path / "lame" / "summary.json").write_text(json.dumps(summary))
    assert "seed_1 failed out of memory" in write_report(RunFolder.open(tmp_path / "lame")).read_text()


def test_an_interrupted_run_has_a_report_too(run, tmp_path):
    shutil.copytree(run.path, tmp_path / "cut")
    (tmp_path / "cut" / "summary.json").unlink()
    (tmp_path / "cut" / "state.json").write_text(json.dumps({"state": "interrupted", "stage": "finalists"}))
    shutil.rmtree(tmp_path / "cut" / "finalists")
    page = write_report(RunFolder.open(tmp_path / "cut")).read_text()
    assert "interrupted" in page
    assert page.count("data:image/png;base64,") == 2


def test_a_run_without_any_trial_has_a_report_too(run, tmp_path):
    for name in ("study.json", "space.json"):
        (tmp_path / name).write_text((run.path / name).read_text())
    (tmp_path / "state.json").write_text(json.dumps({"state": "failed", "stage": "data"}))
    assert "failed" in write_report(RunFolder.open(tmp_path)).read_text()


def test_tables_and_plots_need_neither_ray_nor_torch():
    code = "import sys, cconv.report.tables, cconv.report.plots; print({'ray', 'torch'} & set(sys.modules))"
    finished = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert finished.stdout.strip() == "set()"
