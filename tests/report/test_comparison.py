"""Several studies on one page: what each recommends, and how far errors differ by chance."""

import json
import math
import shutil

import numpy as np
import pytest
from outcomes import assert_one_clear_line
from summaries import SAMPLE, changed, solver_comparison, whole_summary

from cconv.errors import ConfigError
from cconv.report.compared_runs import compared_runs
from cconv.report.comparison import answers_table, differences_table, fronts_chart, write_comparison
from cconv.study.records.run_folder import RunFolder


@pytest.fixture
def copied(tmp_path):
    shutil.copytree(SAMPLE, tmp_path / "copy")
    return tmp_path / "copy"


@pytest.fixture
def runs(copied):
    return compared_runs([RunFolder(SAMPLE), RunFolder(copied)])


def with_errors(run, *errors):
    """The run, whose recommended model had these test errors in its trainings."""
    chosen = run.chosen
    test = changed(chosen.test, by_seed={str(seed): error for seed, error in enumerate(errors)})
    entries = [changed(each, test=test) if each is chosen else each for each in run.summary.finalists]
    return type(run)(label=run.label, summary=changed(run.summary, finalists=entries), inputs=run.inputs)


def test_a_row_is_the_recommended_model_with_its_figures(runs):
    row, other = answers_table(runs).to_dict("records")
    chosen = runs[0].chosen
    assert (row["model"], row["parameters"], row["error"]) == (chosen.id, chosen.num_parameters, chosen.test.error)
    assert (row["ci95_low"], row["ci95_high"]) == chosen.test.ci95
    assert math.isnan(row["solver"])
    assert row["study"] != other["study"]  # two studies of one name are told apart by their folders


def test_the_solvers_time_is_a_multiple_of_the_models(runs):
    run = runs[0]
    beside = type(run)(
        label=run.label, summary=changed(run.summary, solver=solver_comparison(1e-8, 1e-5)), inputs=run.inputs
    )
    (row,) = answers_table([beside]).to_dict("records")
    assert row["solver"] == pytest.approx(8 / run.chosen.cost.ms_per_frame)


def test_twice_the_error_has_the_ratio_two_and_an_interval_around_it(runs):
    reference, other = (
        with_errors(run, *(s * np.array([1.0, 1.2, 0.9, 1.1]))) for run, s in zip(runs, (1, 2), strict=True)
    )
    (row,) = differences_table([reference, other]).to_dict("records")
    assert row["ratio"] == pytest.approx(2)
    assert row["ci95_low"] < 2 < row["ci95_high"]
    assert row["ci95_low"] * row["ci95_high"] == pytest.approx(4)  # symmetric in logarithms
    (nearer,) = differences_table(
        [with_errors(run, *(s * np.array([1.0, 1.01, 0.99, 1.0]))) for run, s in zip(runs, (1, 2), strict=True)]
    ).to_dict("records")
    assert row["ci95_low"] < nearer["ci95_low"] < 2


@pytest.mark.parametrize(
    ("errors", "reason"), [((1.0, 2.0, 1.5), "fewer than 4 trainings of a model"), ((1.0, 0.0), "an error is 0")]
)
def test_what_has_no_interval_says_why(errors, reason, runs):
    (row,) = differences_table([with_errors(runs[0], 1.0, 2.0), with_errors(runs[1], *errors)]).to_dict("records")
    assert row["why_none"] == reason


def test_errors_of_other_data_are_not_divided(runs):
    other = runs[1]
    dataset = changed(other.summary.dataset, path="elsewhere")
    away = type(other)(label=other.label, summary=changed(other.summary, dataset=dataset), inputs=other.inputs)
    assert differences_table([runs[0], away]).empty


def test_inputs_that_are_not_missed_are_named(runs):
    ablation = whole_summary(runs[0].summary).ablation
    needless, missed = (
        changed(ablation.toggled[0], change=f"features.{name}", parameters={f"features.{name}": False}, valid_error=e)
        for name, e in (("density", 1.05 * ablation.error), ("walls", 1.2 * ablation.error))
    )
    summary = changed(runs[0].summary, ablation=changed(ablation, toggled=[needless, missed]))
    found = type(runs[0])(label="a", summary=summary, inputs=runs[0].inputs)
    (row,) = answers_table([found]).to_dict("records")
    assert row["dispensable"] == "density"


def test_the_page_and_its_chart_name_each_study(runs, tmp_path):
    write_comparison(runs, tmp_path / "page.html")
    page = (tmp_path / "page.html").read_text()
    (axes,) = fronts_chart(runs).axes
    labels = {text.get_text() for text in axes.get_legend().get_texts()}
    assert labels == {run.label for run in runs}
    assert all(label in page for label in labels)


def test_the_command_prints_both_tables(copied, cconv, tmp_path):
    code, printed, _ = cconv("study", "compare", SAMPLE, copied, "--json", "--out", tmp_path / "page.html")
    assert code == 0
    facts = json.loads(printed)
    assert len(facts["answers"]) == 2
    assert facts["differences"][0]["ratio"] == pytest.approx(1)
    outcome = cconv("study", "compare", SAMPLE, copied, "--out", tmp_path / "page.html")
    assert_one_clear_line(outcome, "page.html exists")


def test_what_cannot_be_compared_is_told(copied):
    with pytest.raises(ConfigError, match="is given twice"):
        compared_runs([RunFolder(copied), RunFolder(copied)])
    (copied / "summary.json").unlink()
    with pytest.raises(ConfigError, match="the study has not finished"):
        compared_runs([RunFolder(SAMPLE), RunFolder(copied)])
