"""One whole study of the smallest size, looked at from all sides."""

import json
import math

import optuna
import pytest
import torch
from studies import Silent, begin_search

from cconv import load_model, open_dataset
from cconv.models.errors import frame_errors, normalized_mse
from cconv.study.declared.domains import SearchSpace, fixed
from cconv.study.declared.search_space import load_space
from cconv.study.pipeline import run_study
from cconv.study.records.run_folder import RunFolder
from cconv.study.running.optuna_mirror import open_storage
from cconv.tasks.samples import iterate_samples


@pytest.fixture
def run(finished_run):
    return RunFolder.open(finished_run)


@pytest.fixture
def summary(run):
    return run.summary()


def test_the_baseline_is_trained_to_the_full_budget_and_is_a_finalist(run, summary):
    space = SearchSpace.model_validate(run.read("space.json"))
    (baseline,) = run.trials_of("baseline")
    assert (baseline.outcome, baseline.parameters) == ("completed", fixed(space, "boundary").baseline)
    assert summary.baseline in {entry.id for entry in summary.finalists}


def test_a_serial_study_ran_where_ray_cannot_be_imported_and_says_that_it_trained_one_at_a_time(run):
    """The fixture blocks the import of Ray."""
    environment = run.read("environment.json")
    assert environment["command"][0] == "-c"
    assert environment["threads"]["trials_at_once"] == 1
    assert not (run.path / "ray").exists()


def test_every_trial_ended_with_an_outcome_and_is_counted(run, summary):
    records = run.trials()
    assert all(record.outcome in ("completed", "stopped", "diverged") for record in records)
    counts = {stage: sum(outcomes.values()) for stage, outcomes in summary.trials.items()}
    known = {"closed_form": 4, "initialization": 6, "baseline": 1, "random": 4, "adaptive": 3}
    assert {stage: counts[stage] for stage in known} == known
    assert sum(counts.values()) == len(records) + sum(len(each) for each in run.retrainings().values())


def test_every_stage_left_what_it_found(run):
    study = run.read("study.json")
    assert [stage for stage in study["stages"] if not run.has_result(stage)] == []
    assert run.result("select").recommended == run.summary().recommended.id


def test_the_adaptive_stage_searches_the_refined_space(run):
    refined = load_space(run.path / "stages" / "refine.toml")
    assert all(refined.holds(record.parameters) for record in run.trials_of("adaptive"))
    reasons = run.summary().refined
    assert set(reasons) >= set(refined.parameters)


def test_every_trial_is_below_the_cap_on_cost(run):
    cap = run.read("space.json")["max_flops_per_particle"]
    assert all(record.config["flops_per_particle"] <= cap for record in run.trials())


def test_all_trials_share_data_seed_and_searched_ones_their_initial_weights(run):
    records = run.trials()
    assert len({record.config["data_seed"] for record in records}) == 1
    searched = [record for record in records if record.stage != "initialization"]
    assert len({record.config["init_seed"] for record in searched}) == 1


def test_the_reference_trains_what_the_search_stopped_with_what_the_search_spent(run, summary):
    for name, strategy in summary.references.strategies.items():
        assert strategy.updates > 0, name
    asha, little = (summary.references.strategies[f"random, {name}"] for name in ("ASHA", "a little each"))
    full = run.read("study.json")["training"]["updates"]
    assert abs(little.updates - asha.updates) <= full
    assert asha.best_valid == min(record.best for record in run.trials_of("random") if record.outcome == "completed")


def test_rungs_hold_the_errors_of_the_logs(run):
    logs = {record.id: {entry["updates"]: entry["valid_error"] for entry in record.log} for record in run.trials()}
    for rungs in run.read("rungs.json").values():
        for rung in rungs:
            for trial, error in rung["recorded"].items():
                assert error == logs[trial][rung["updates"]]


def test_finalists_were_retrained_with_seeds_that_the_search_did_not_use(run):
    search_seed = run.read("study.json")["seeds"]["init"]
    for finalist, records in run.retrainings().items():
        seeds = [record.config["init_seed"] for record in records]
        once = records[0].is_closed_form or finalist.startswith("ablation_")
        assert len(set(seeds)) == (1 if once else 2)
        assert search_seed not in seeds


@pytest.mark.parametrize("split", ["valid", "test"])
def test_the_checkpoint_gives_the_reported_errors_again(run, summary, flow_folder, split):
    dataset = open_dataset(flow_folder)
    for entry in summary.finalists:
        model = load_model(run.path / entry.checkpoint, task=summary.task.name)
        errors = frame_errors(model, iterate_samples(dataset, split, model.task))
        seed = (run.path / entry.checkpoint).parent.name
        assert normalized_mse(errors) == pytest.approx(getattr(entry, split).by_seed[seed], rel=1e-6)
        assert model.num_parameters == entry.num_parameters


def test_the_summary_holds_what_every_stage_found_and_consistent_figures(summary):
    assert {"ablation", "importance", "initialization", "references", "refined"} <= set(summary.found())
    names = {entry.id for entry in summary.finalists}
    assert summary.baseline in names
    assert summary.recommended.id in names
    assert set(summary.pareto_front) <= names
    for entry in summary.finalists:
        assert entry.test.ci95 is None  # of a single test trajectory
        assert entry.test.units.count == 1
        roots = [math.sqrt(error) for error in entry.test.by_seed.values()]
        assert entry.test.measures["relative RMSE"] == pytest.approx(sum(roots) / len(roots))


def test_what_was_chosen_was_chosen_by_validation_errors_and_each_split_has_its_mean_predictor(
    run, summary, flow_folder
):
    dataset, comparisons = open_dataset(flow_folder), summary.selection.comparisons
    errors = {entry.id: entry.valid.error for entry in summary.finalists}
    assert {each.id: each.error for each in comparisons} == pytest.approx(errors)
    assert summary.recommended.id in {each.id for each in comparisons if each.eligible}
    task = load_model(run.path / summary.finalists[0].checkpoint).task
    train, valid, test = (
        torch.cat([sample.target for sample in iterate_samples(dataset, split, task)]).double()
        for split in ("train", "valid", "test")
    )
    variance = train.var(dim=0, correction=0).mean()
    for split, targets in (("valid", valid), ("test", test)):
        expected = (targets - train.mean(dim=0)).square().mean() / variance
        assert getattr(summary.mean_predictor, split) == pytest.approx(expected.item(), rel=1e-4)


def test_provenance_is_recorded(run, flow_folder):
    environment = run.read("environment.json")
    assert environment["data"]["sha256"] == open_dataset(flow_folder).fingerprint()
    assert environment["packages"]["torch"]
    assert set(environment["seeds"]) == {"data", "init", "search"}
    assert environment["data_findings"] == []


def test_optunas_journal_holds_both_searches_and_no_trial_without_an_end(run):
    study = optuna.load_study(study_name="smoke", storage=open_storage(run.path / "optuna.journal"))
    assert len(study.trials) == 7
    assert all(trial.state.is_finished() for trial in study.trials)


def test_nothing_half_written_remains(run):
    assert [path for path in run.path.rglob(".*")] == []
    assert json.loads((run.path / "state.json").read_text())["state"] == "finished"


def test_the_ablation_goes_from_the_baseline_to_the_best_trained_finalist(run, summary):
    path = summary.ablation.path
    space = SearchSpace.model_validate(run.read("space.json"))
    assert path[0].parameters == space.baseline
    assert len(path) > 1
    assert all(step.valid_error > 0 for step in path)
    (density,) = [entry for entry in summary.ablation.toggled if entry.change == "task.features.density"]
    assert density.valid_error > 0


def test_the_explanation_of_the_recommended_model_and_the_baseline_is_kept(run, summary):
    kept = {path.stem for path in (run.path / "explanation").glob("*.npz")}
    assert kept == {"baseline", summary.recommended.id}


SPACE_WITH_FAILURES = """
name = "failures"
description = "Half of the cutoffs reach farther than half of the periodic box, which no neighbour search can do."

[parameters.network.relative_cutoff]
type = "choice"
values = [2.0, 6.0]
baseline = 2.0
reason = "The second fails."
"""

STUDY_WITH_FAILURES = """
name = "failures"
task = "density_gradient"

[network]
layers = 2
first_channels = 4

[training]
updates = 12
evaluate_every = 6

[search]
space = "{space}"
grace_updates = 6

[stages.random]
trials = 4

[stages.adaptive]
trials = 2

[stages.finalists]

[stages.select]

[finalists]
seeds = 2

[cost]
repeats = 3
"""


@pytest.mark.integration
def test_a_trial_that_fails_is_an_outcome_and_the_study_goes_on(cconv, flow_folder, tmp_path):
    """With no challenger at the full budget left, the baseline is alone. More trials go on from there."""
    (tmp_path / "space.toml").write_text(SPACE_WITH_FAILURES)
    (tmp_path / "failures.toml").write_text(STUDY_WITH_FAILURES.format(space=tmp_path / "space.toml"))
    folder = tmp_path / "run"
    run = begin_search(tmp_path / "failures.toml", flow_folder, folder)
    run_study(run, Silent(), serial=True)
    failed = [record for record in run.trials() if record.outcome == "failed"]
    assert {record.parameters["network.relative_cutoff"] for record in failed} == {6.0}
    assert all("half of every periodic axis" in record.reason for record in failed)
    counts = run.summary().trials
    assert counts["random"]["failed"] + counts["adaptive"]["failed"] == len(failed) >= 1
    assert [entry.id for entry in run.summary().finalists] == ["baseline"]
    before = {record.id: record.log for record in run.trials()}
    status, _, error = cconv("study", "extend", folder, "--serial", "--stage", "random", "--trials", "3")
    assert status == 0, error
    after = {record.id: record.log for record in run.trials()}
    assert len(after) == 9
    assert {trial: log for trial, log in after.items() if trial in before} == before
    assert run.read("state.json")["state"] == "finished"
