"""One whole study of the smallest size, looked at from all sides."""

import json
import subprocess

import optuna
import pytest
from conftest import SCRIPT, SMOKE

from cconv import load_model, open_dataset
from cconv.data.targets import iterate_samples
from cconv.evaluation.metrics import frame_errors, normalized_mse
from cconv.study.optuna_mirror import open_journal
from cconv.study.records import RunFolder
from cconv.study.space import SearchSpace


@pytest.fixture
def run(finished_run):
    return RunFolder.open(finished_run)


@pytest.fixture
def summary(run):
    return run.read("summary.json")


def test_the_baseline_comes_first_in_both_searches(run):
    space = SearchSpace.model_validate(run.read("space.json"))
    parameters = {record.id: record.parameters for record in run.trials()}
    assert parameters["random_0000"] == space.baseline
    assert parameters["adaptive_0000"] == space.baseline


def test_every_trial_ended_with_an_outcome_and_is_counted(run, summary):
    records = run.trials()
    assert len(records) == 12
    assert all(record.outcome in ("completed", "stopped", "diverged") for record in records)
    counts = {stage: sum(outcomes.values()) for stage, outcomes in summary["trials"].items()}
    assert counts == {"closed_form": 4, "initialization": 2, "random": 3, "adaptive": 3, "finalists": 5}


def test_all_trials_share_data_seed_and_differ_in_nothing_else_than_parameters(run):
    records = run.trials()
    assert len({record.config["data_seed"] for record in records}) == 1
    searched = [record for record in records if record.stage != "initialization"]
    assert len({record.config["init_seed"] for record in searched}) == 1


def test_rungs_hold_the_errors_of_the_logs(run):
    logs = {
        record.id: {entry["updates"]: entry["valid_normalized_mse"] for entry in record.log} for record in run.trials()
    }
    for rungs in run.read("rungs.json").values():
        for rung in rungs:
            for trial, error in rung["recorded"].items():
                assert error == logs[trial][rung["updates"]]


def test_finalists_were_retrained_with_seeds_that_the_search_did_not_use(run):
    search_seed = run.read("study.json")["seeds"]["init"]
    for records in run.retrainings().values():
        seeds = [record.config["init_seed"] for record in records]
        assert len(set(seeds)) == (1 if records[0].is_closed_form else 2)
        assert search_seed not in seeds


def test_the_checkpoint_gives_the_reported_test_error_again(run, summary, flow_folder):
    dataset = open_dataset(flow_folder)
    for entry in summary["finalists"]:
        model = load_model(run.path / entry["checkpoint"], task=summary["task"])
        errors = frame_errors(model, iterate_samples(dataset, "test", summary["task"], model.kernel))
        seed = (run.path / entry["checkpoint"]).parent.name
        assert normalized_mse(errors) == pytest.approx(entry["test"]["by_seed"][seed], rel=1e-6)
        assert model.num_parameters == entry["num_parameters"]


def test_summary_has_the_agreed_keys_and_consistent_figures(summary):
    assert {"study", "task", "dataset", "baseline", "finalists", "pareto_front", "recommended", "trials"} <= set(
        summary
    )
    names = {entry["id"] for entry in summary["finalists"]}
    assert summary["baseline"] in names
    assert summary["recommended"]["id"] in names
    assert set(summary["pareto_front"]) <= names
    for entry in summary["finalists"]:
        low, high = entry["test"]["ci95"]
        assert low <= entry["test"]["normalized_mse"] <= high
        assert entry["test"]["relative_rmse"] ** 2 == pytest.approx(entry["test"]["normalized_mse"])
        assert {"ms_per_frame", "us_per_particle", "peak_mb", "flops_per_particle"} <= set(entry["cost"])


def test_provenance_is_recorded(run, flow_folder):
    environment = run.read("environment.json")
    assert environment["data"]["sha256"] == open_dataset(flow_folder).fingerprint()
    assert environment["packages"]["torch"]
    assert set(environment["seeds"]) == {"data", "init", "search"}


def test_optunas_journal_holds_both_searches_and_no_trial_without_an_end(run):
    study = optuna.load_study(study_name="smoke", storage=open_journal(run.path / "optuna.journal"))
    assert len(study.trials) == 6
    assert all(trial.state.is_finished() for trial in study.trials)


def test_nothing_half_written_remains(run):
    assert [path for path in run.path.rglob(".*")] == []
    assert json.loads((run.path / "state.json").read_text())["state"] == "finished"


SPACE_WITH_FAILURES = """
name = "failures"
description = "Half of the cutoffs reach farther than half of the periodic box, which no neighbour search can do."

[parameters.relative_cutoff]
type = "choice"
values = [2.0, 6.0]
baseline = 2.0
reason = "The second fails."
"""


def test_a_trial_that_fails_is_an_outcome_and_the_study_goes_on(flow_folder, tmp_path):
    """With no challenger at the full budget left, the baseline is compared with closed forms alone."""
    (tmp_path / "space.toml").write_text(SPACE_WITH_FAILURES)
    command = [SCRIPT, "study", "run", SMOKE, "--data", flow_folder, "--out", tmp_path / "run"]
    settings = [f"search.space={tmp_path / 'space.toml'}", "search.random_trials=6", "search.adaptive_trials=0"]
    options = [part for setting in settings for part in ("--set", setting)]
    finished = subprocess.run([*command, *options], capture_output=True, text=True, timeout=200)
    assert finished.returncode == 0, finished.stderr
    run = RunFolder.open(tmp_path / "run")
    failed = [record for record in run.trials() if record.outcome == "failed"]
    assert {record.parameters["relative_cutoff"] for record in failed} == {6.0}
    assert all("half of every periodic axis" in record.reason for record in failed)
    summary = run.read("summary.json")
    for stage in ("random", "closed_form"):
        assert summary["trials"][stage]["failed"] == sum(record.stage == stage for record in failed) >= 1
    trained = [entry["id"] for entry in summary["finalists"] if not entry["id"].startswith("closed_form")]
    assert trained == ["baseline"]
