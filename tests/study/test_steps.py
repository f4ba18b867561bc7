"""A whole study of steps, from the closed form to the report: what is compared are rollouts."""

import json

import pytest
import torch
from conftest import SMOKE, run_main
from outcomes import assert_one_clear_line

from cconv import load_model
from cconv.data.dataset import open_dataset
from cconv.study.records.rollouts import read_rollouts
from cconv.study.records.run_folder import RunFolder
from cconv.tasks import TASKS

LONGEST = 6  # history in the space, at whose presents all models begin

pytestmark = pytest.mark.integration


@pytest.fixture(scope="module")
def run(steps_folder, tmp_path_factory):
    folder, study = tmp_path_factory.mktemp("steps_study") / "run", SMOKE.with_name("smoke_steps.toml")
    assert run_main("study", "run", study, "--serial", "--data", steps_folder, "--out", folder) == 0
    return RunFolder.open(folder)


def test_models_are_compared_by_rollouts_and_no_analytic_field(run):
    summary = run.summary()
    assert (summary.task.name, summary.task.error) == ("acceleration", "rollout MSE")
    assert summary.analytic is None
    assert summary.explained == ()
    assert set(summary.checks) == set(TASKS["acceleration"].checks)
    for entry in summary.finalists:
        assert set(entry.test.measures) == {"first-frame MSE", "MSE5", "diverged rollouts"}
        assert 0 < entry.test.error < 0.25
        assert entry.stability.counts.plain_frames == 1 + 6  # from the start of the trajectory, and from others


def test_a_scene_without_walls_and_force_has_no_input_for_them(run):
    for entry in run.summary().finalists:
        config = json.loads((run.path / entry.checkpoint / "config.json").read_text())
        assert not {"force", "particle_type"} & set(config["features"])


def test_models_of_all_histories_are_compared_at_the_same_presents(run, cconv):
    """So that an error can be computed again from the checkpoint alone."""
    for entry in run.summary().finalists:
        card = json.loads((run.path / entry.checkpoint / "card.json").read_text())
        config = json.loads((run.path / entry.checkpoint / "config.json").read_text())
        assert (card["window"], config["history"]) == (LONGEST, card["parameters"].get("task.history"))
        code, printed, _ = cconv("evaluate", run.path / entry.checkpoint, "--split", "valid", "--json")
        assert code == 0
        assert json.loads(printed)["rollout_mse"] == pytest.approx(card["valid_error"], rel=1e-3)


def test_the_solver_that_made_the_data_stands_beside_the_networks(run):
    summary = run.summary()
    solver, *coarser = summary.solver.points
    assert summary.solver.why_none == ""
    assert summary.task.horizon == 5
    assert solver.factor == 1
    assert solver.error < summary.mean_predictor.test
    usual, slow = ([point for point in summary.solver.points if (point.sound_ratio == 10) == same] for same in (1, 0))
    assert all(coarse.num_particles < solver.num_particles for coarse in usual[1:] + slow[1:])
    assert all(point.steps < solver.steps for point in coarser)
    for series in (usual, slow):
        assert all(point.ms_per_frame > summary.chosen.cost.ms_per_frame for point in series[:-1])
    page = (run.path / "report.html").read_text()
    assert "the solver that made the data, restarted from the same frames, errs by" in " ".join(page.split())


def test_the_report_speaks_of_rollouts(run):
    page = (run.path / "report.html").read_text()
    assert "rollouts from the validation split" in page
    assert "squared lengths of the data" in page
    assert "analytic SPH" not in page


def test_the_recommended_model_of_the_run_is_rolled_out_and_evaluated(run, cconv):
    code, printed, _ = cconv("rollout", run.path, "--frames", 6, "--json")
    assert code in (0, 1)  # a model of six updates may diverge
    chosen = str(run.path / run.summary().offered_checkpoint)
    assert json.loads(printed)["checkpoint"] == chosen
    assert json.loads(cconv("evaluate", run.path, "--json")[1])["checkpoint"] == chosen


def test_the_relaxation_was_chosen_by_validation_rollouts_and_is_applied(run, cconv):
    summary = run.summary()
    relaxed, own = summary.relaxed, summary.recommended.id
    chosen = relaxed.models[own].tried[relaxed.chosen[own]]
    assert set(relaxed.models) == {own, summary.selection.best}
    assert relaxed.models[own].tried[0].quality == 1
    applied = json.loads(cconv("rollout", run.path, "--frames", 3, "--json")[1])["relaxation"]
    assert applied == (chosen.model_dump(include={"alpha", "beta", "loops"}) if relaxed.checkpoint else None)
    assert json.loads(cconv("rollout", run.path, "--frames", 3, "--no-relax", "--json")[1])["relaxation"] is None
    assert '<h2 id="relaxation">' in (run.path / "report.html").read_text()


def test_every_training_of_a_finalist_is_rolled_out_over_the_whole_test_trajectory(run):
    summary = run.summary()
    assert summary.rolled == tuple(entry.id for entry in summary.finalists)
    stored = open_dataset(summary.dataset.path).trajectory("test", 0)
    for entry in summary.finalists:
        (found,) = read_rollouts(run, [entry.id]).values()
        assert {each.seed for each in found.rolled} == set(entry.test.by_seed)
        for each in found.rolled:
            assert (each.trajectory, each.stored) == (stored.name, len(stored) - LONGEST)
            assert len(each.mse) == each.stored or each.ended.startswith("diverged")
            assert sum(each.reference.neighbors) == pytest.approx(1)
            step = entry.test.measures["first-frame MSE"]
            assert each.mse[0] <= step * len(entry.test.by_seed) * 1.001


def test_the_frames_of_the_first_rollout_of_the_recommended_model_are_kept_and_drawn(run):
    rolled = open_dataset(run.path / "rollouts" / "recommended")
    (found,) = read_rollouts(run, [run.summary().recommended.id]).values()
    assert len(rolled.trajectory("test", 0)) in {LONGEST + len(each.mse) for each in found.rolled}
    page = (run.path / "report.html").read_text()
    assert 'src="data:image/gif;base64,R0lGOD' in page
    assert '<h2 id="rollouts">' in page


CORRECTED = """
name = "corrected"
[task]
name = "acceleration"
history = 3
horizon = 5
[predictor]
noise = 0.0
[predictor.network]
architecture = "radial_net"
layers = 1
message = "mixed"
radial_terms = 6
relative_cutoff = 3.0
[training]
updates = 6
evaluate_every = 3
[search]
space = "{space}"
grace_updates = 3
[stages.baseline]
"""


def test_a_study_fits_its_predictor_once_and_its_networks_correct_it(steps_folder, cconv, tmp_path):
    space = SMOKE.parents[1] / "search_spaces" / "rollout_corrected.toml"
    (tmp_path / "study.toml").write_text(CORRECTED.format(space=space))
    given = ("--serial", "--data", steps_folder, "--out", tmp_path / "run")
    assert cconv("study", "run", tmp_path / "study.toml", *given)[0] == 0
    run = RunFolder.open(tmp_path / "run")
    predictor, (trial,) = load_model(run.path / "predictor"), run.trials()
    assert trial.last_error is not None
    within = load_model(run.trial(trial.id).checkpoint).predictor
    assert all(torch.equal(value, within.state_dict()[name]) for name, value in predictor.state_dict().items())
    files = run.path / "predictor" / "model.safetensors", run.path / "predictor" / "card.json"
    fitted = [file.stat().st_mtime_ns for file in files]
    run.forget_result("baseline")
    assert cconv("study", "resume", run.path, "--serial")[0] == 0
    assert [file.stat().st_mtime_ns for file in files] == fitted


TIMED = """
name = "timed"
[task]
name = "acceleration"
history = 3
horizon = 6
[network]
architecture = "radial_net"
layers = 2
first_channels = 2
message = "mixed"
radial_terms = 4
[training]
cpu_seconds = 0.2
updates = 100000
evaluate_every = 100000
[search]
space = "{space}"
grace_updates = 100000
[stages.finalists]
include.small_gns = {{ network.architecture = "gns", network.layers = 1, network.hidden_channels = 8 }}
[stages.select]
[finalists]
seeds = 1
[cost]
repeats = 3
trials = 0
sizes = [100]
"""
ONE_NETWORK = """
name = "one"
description = "A single network."
[parameters.network.radial_terms]
type = "choice"
values = [4]
baseline = 4
reason = "Nothing is searched."
"""


def test_a_study_without_a_search_trains_named_networks_for_equal_time(steps_folder, cconv, tmp_path):
    (tmp_path / "space.toml").write_text(ONE_NETWORK)
    (tmp_path / "study.toml").write_text(TIMED.format(space=tmp_path / "space.toml"))
    given = ("--serial", "--data", steps_folder, "--out", tmp_path / "run")
    assert cconv("study", "run", tmp_path / "study.toml", *given)[0] == 0
    run = RunFolder.open(tmp_path / "run")
    trained = {entry.id: entry for entry in run.summary().finalists}
    assert set(trained) == {"baseline", "small_gns"}
    for name, entry in trained.items():
        (record,) = run.retrainings()[name]
        assert record.outcome == "completed"
        assert 0.2 <= entry.train_cpu_seconds == record.log[-1]["cpu_seconds"]
        assert entry.updates == record.log[-1]["updates"] < 100_000
        assert 0 < record.log[-1]["learning_rate"] < 1e-3  # which falls with the share of the time that is spent
        card = json.loads((run.path / entry.checkpoint / "card.json").read_text())
        assert card["cpu_seconds"] == entry.train_cpu_seconds
        assert entry.test.ci95 is None
        assert entry.test.why_no_interval.startswith("1 training says too little of others")
        assert entry.test.measures["MSE5"] <= entry.test.error
    code, printed, _ = cconv("study", "compare", run.path, "--json", "--out", tmp_path / "page.html")
    assert code == 0
    scores = {row["model"]: row for row in json.loads(printed)["scores"]}
    for name, entry in trained.items():
        (found,) = read_rollouts(run, [name])[name].rolled
        assert scores[name]["error"] == entry.test.error
        if not found.ended:
            assert scores[name]["sinkhorn"] == pytest.approx(sum(found.sinkhorn) / len(found.sinkhorn))
    assert "Scoreboard" in (tmp_path / "page.html").read_text()
    code, printed, _ = cconv("study", "compare", run.path)
    assert (code, "Scoreboard" in printed, "CPU min" in printed) == (0, True, True)


def test_a_space_whose_networks_look_back_less_far_than_the_predictor_is_refused(steps_folder, cconv, tmp_path):
    space = SMOKE.parents[1] / "search_spaces" / "rollout.toml"
    (tmp_path / "study.toml").write_text(CORRECTED.format(space=space))
    given = ("--serial", "--data", steps_folder, "--out", tmp_path / "run")
    outcome = cconv("study", "run", tmp_path / "study.toml", *given)
    assert_one_clear_line(outcome, "task.history: must be at least 3, that of the predictor, got 2")
    assert not (tmp_path / "run").exists()
