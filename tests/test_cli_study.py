import json
import os
import shutil
import signal
import subprocess
import time

import h5py
import pytest
from conftest import SCRIPT, SMOKE
from outcomes import assert_one_clear_line
from processes import PATIENCE

from cconv import load_model
from cconv.study.records.run_folder import RunFolder


@pytest.fixture
def own_run(finished_run, tmp_path):
    """A copy of the finished run that a test may lock and write to, while others read the run itself."""
    return shutil.copytree(finished_run, tmp_path / "own")


def test_evaluate_gives_the_reported_test_error_again(cconv, finished_run):
    for entry in RunFolder(finished_run).summary().finalists:
        checkpoint = finished_run / entry.checkpoint
        status, out, _ = cconv("evaluate", checkpoint, "--json")
        assert status == 0
        reported = entry.test.by_seed[checkpoint.parent.name]
        assert json.loads(out)["normalized_mse"] == pytest.approx(reported, rel=1e-6)


def test_status_and_report_of_a_finished_run(cconv, own_run):
    status, out, _ = cconv("study", "status", own_run, "--json")
    facts = json.loads(out)
    assert status == 0
    assert facts["state"] == "finished"
    assert facts["best"]["valid_error"] > 0
    status, out, _ = cconv("study", "status", own_run)
    assert "finished" in out
    status, out, _ = cconv("report", own_run)
    assert (status, "report.html" in out) == (0, True)


def test_fit_leaves_a_checkpoint_that_evaluates(cconv, flow_folder, tmp_path):
    layer = [
        setting
        for value in ("layers=1", "architecture=radial_net", "message=difference", "relative_cutoff=2.0")
        for setting in ("--set", f"network.{value}")
    ]
    command = ("fit", SMOKE, "--data", flow_folder, "--out", tmp_path / "one", *layer)
    status, out, _ = cconv(*command)
    assert status == 0
    assert "Validation error" in out
    status, out, _ = cconv("evaluate", tmp_path / "one", "--split", "valid", "--json")
    facts = json.loads(out)
    assert facts["normalized_mse"] < 0.05
    assert facts["mean_predictor_normalized_mse"] > 10 * facts["normalized_mse"]
    assert facts["own_normalized_mse"] != facts["normalized_mse"]
    status, out, _ = cconv("evaluate", tmp_path / "one", "--split", "valid")
    assert "By the variance of these data instead of the training split's: " in out
    assert "Predicting the mean of the training split here: " in out
    assert_one_clear_line(cconv(*command), "exists already")


def test_fit_needs_a_single_layer(cconv, flow_folder, tmp_path):
    outcome = cconv("fit", SMOKE, "--data", flow_folder, "--out", tmp_path / "one", "--set", "network.layers=2")
    assert_one_clear_line(outcome, "`network.layers` must be 1")
    assert not (tmp_path / "one").exists()


def test_a_loss_that_is_no_sum_of_squares_is_refused_before_the_data_are_read(cconv, tmp_path):
    loss = ("--set", "training.loss=neighbor_weighted")
    outcome = cconv("fit", SMOKE, "--data", tmp_path / "none", "--out", tmp_path / "one", *loss)
    assert_one_clear_line(outcome, "`training.loss` must be 'mse' or 'balanced_mse' for", "got 'neighbor_weighted'")
    assert not (tmp_path / "one").exists()


def test_train_leaves_a_checkpoint_that_evaluates(cconv, flow_folder, tmp_path):
    status, out, _ = cconv("train", SMOKE, "--data", flow_folder, "--out", tmp_path / "one")
    assert status == 0
    assert "Best validation error" in out
    status, out, _ = cconv("evaluate", tmp_path / "one" / "checkpoint", "--split", "valid", "--json")
    card = json.loads((tmp_path / "one" / "checkpoint" / "card.json").read_text())
    assert json.loads(out)["normalized_mse"] == pytest.approx(card["valid_error"], rel=1e-6)


def test_a_training_that_diverges_says_so(cconv, flow_folder, tmp_path):
    large = ("training.learning_rate=1e3", "network.layers=12", "network.activation=leaky_relu")
    settings = [part for setting in large for part in ("--set", setting)]
    status, _, error = cconv("train", SMOKE, "--data", flow_folder, "--out", tmp_path / "one", *settings)
    assert status == 1
    assert "Diverged" in error


def test_bad_input_ends_in_one_line_and_leaves_no_run_folder(cconv, flow_folder, tmp_path):
    out = ("--out", tmp_path / "run")
    run = ("study", "run", SMOKE)
    assert_one_clear_line(cconv(*run, "--data", tmp_path / "nowhere", *out), "nowhere", "does not exist")
    assert_one_clear_line(cconv(*run, *out), "data.path", "--data")
    assert_one_clear_line(cconv("study", "run", tmp_path / "no.toml", *out), "no.toml", "no such file")
    typo = ("--set", "stages.random.trial=3")
    assert_one_clear_line(cconv(*run, "--data", flow_folder, *typo, *out), "stages.random.trial", "trials")
    missing = ("--set", 'stages.adaptive.space="refined"')
    assert_one_clear_line(cconv(*run, "--data", flow_folder, *missing, *out), "`adaptive`", "`refined`", "'refine'")
    late = ("--set", "search.grace_updates=600")
    assert_one_clear_line(cconv(*run, "--data", flow_folder, *late, *out), "grace_updates (600) must not exceed")
    outside = ("--set", "network.kernel_size=0")
    assert_one_clear_line(cconv(*run, "--data", flow_folder, *outside, *out), "network.kernel_size", "got 0")
    nowhere = ("--set", "search.space=none.toml")
    assert_one_clear_line(cconv(*run, "--data", flow_folder, *nowhere, *out), "none.toml", "no such file")
    assert not (tmp_path / "run").exists()


def test_an_unknown_key_in_a_search_space_is_named(cconv, flow_folder, tmp_path):
    space = (SMOKE.parents[1] / "search_spaces" / "smoke.toml").read_text()
    (tmp_path / "space.toml").write_text(space.replace("reason", "reson", 1))
    settings = ("--set", f"search.space={tmp_path / 'space.toml'}")
    outcome = cconv("study", "run", SMOKE, "--data", flow_folder, *settings, "--out", tmp_path / "run")
    assert_one_clear_line(outcome, "space.toml", "reson", "Did you mean 'reason'")


def test_data_that_turn_out_damaged_leave_no_run_folder_or_training(cconv, flow_folder, tmp_path):
    shutil.copytree(flow_folder, tmp_path / "nan")
    with h5py.File(tmp_path / "nan" / "valid.h5", "r+") as file:
        file["00000"]["position"][1, 2, 0] = float("nan")
    for command in (("study", "run", SMOKE), ("train", SMOKE)):
        outcome = cconv(*command, "--data", tmp_path / "nan", "--out", tmp_path / "out")
        assert_one_clear_line(outcome, "valid.h5", "NaN", "frame 1")
        assert not (tmp_path / "out").exists()


def test_a_cutoff_that_the_box_cannot_hold_is_named_and_leaves_nothing(cconv, flow_folder, tmp_path):
    settings = ("--set", "network.relative_cutoff=9")
    outcome = cconv("train", SMOKE, "--data", flow_folder, *settings, "--out", tmp_path / "out")
    assert_one_clear_line(outcome, "half of every periodic axis")
    assert not (tmp_path / "out").exists()


def test_a_place_that_cannot_be_written_is_named(cconv, flow_folder, tmp_path):
    (tmp_path / "file").write_text("")
    outcome = cconv("study", "run", SMOKE, "--data", flow_folder, "--out", tmp_path / "file" / "run")
    assert_one_clear_line(outcome, "file")


def test_damaged_records_are_named(cconv, finished_run, tmp_path):
    shutil.copytree(finished_run, tmp_path / "run")
    log = next((tmp_path / "run" / "trials").glob("*/log.jsonl"))
    log.write_text("{]}\n" + log.read_text())
    assert_one_clear_line(cconv("report", tmp_path / "run"), "log.jsonl", "delete that line")
    checkpoint = tmp_path / "run" / RunFolder(finished_run).summary().chosen.checkpoint
    (checkpoint / "card.json").write_text("{")
    assert_one_clear_line(cconv("evaluate", checkpoint), "card.json")


def test_an_unknown_split_is_named(cconv, finished_run):
    outcome = cconv("evaluate", finished_run / RunFolder(finished_run).summary().chosen.checkpoint, "--split", "tset")
    assert_one_clear_line(outcome, "tset", "Did you mean 'test'")


def test_an_existing_run_is_not_touched(cconv, finished_run, flow_folder):
    before = (finished_run / "summary.json").read_bytes()
    outcome = cconv("study", "run", SMOKE, "--data", flow_folder, "--out", finished_run)
    assert_one_clear_line(outcome, "exists already", "--overwrite")
    assert (finished_run / "summary.json").read_bytes() == before


def test_a_checkpoint_of_another_task_is_refused(cconv, finished_run):
    checkpoint = finished_run / RunFolder(finished_run).summary().chosen.checkpoint
    outcome = cconv("evaluate", checkpoint, "--task", "density_rate")
    assert_one_clear_line(outcome, "density_gradient", "density_rate")


@pytest.mark.parametrize(
    "command",
    [("run", SMOKE, "--data", "flow"), ("resume", "run"), ("extend", "run", "--stage", "random", "--trials", "1")],
    ids=lambda command: command[0],
)
def test_a_serial_study_is_on_no_cluster(cconv, command):
    outcome = cconv("study", *command, "--serial", "--address", "127.0.0.1:6379")
    assert_one_clear_line(outcome, "--serial", "--address", "give one of them")


def test_what_is_no_run_or_checkpoint_is_named(cconv, tmp_path):
    assert_one_clear_line(cconv("study", "status", tmp_path), "study.json")
    assert_one_clear_line(cconv("report", tmp_path), "study.json")
    assert_one_clear_line(cconv("evaluate", tmp_path), "model.safetensors")


def interrupt(command, ready, timeout=PATIENCE):
    """Start a command in a process group of its own, wait until `ready`, press Ctrl-C; gives its exit status."""
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, start_new_session=True)
    deadline = time.monotonic() + timeout
    while not ready() and process.poll() is None and time.monotonic() < deadline:
        time.sleep(0.2)
    os.killpg(process.pid, signal.SIGINT)
    _, error = process.communicate(timeout=PATIENCE)
    return process.returncode, error.decode()


@pytest.mark.slow
def test_ctrl_c_leaves_a_readable_run_folder(cconv, flow_folder, tmp_path):
    folder = tmp_path / "run"
    long = ["--set", "training.updates=100000", "--set", "search.grace_updates=60"]
    command = [SCRIPT, "study", "run", SMOKE, "--data", flow_folder, "--out", folder, *long]

    def ready():
        return any(path.stat().st_size for path in folder.glob("trials/initialization_*/log.jsonl"))

    status, error = interrupt(command, ready)
    assert status == 130
    assert "Traceback" not in error
    status, out, _ = cconv("study", "status", folder, "--json")
    facts = json.loads(out)
    assert facts["state"] == "interrupted"
    assert facts["trials"]["initialization"]["interrupted"] >= 1
    assert "interrupted" in (folder / "report.html").read_text()
    assert load_model(next(folder.glob("trials/*/checkpoint"))).num_parameters > 0


@pytest.mark.slow
def test_ctrl_c_leaves_a_usable_checkpoint_of_a_training(flow_folder, tmp_path):
    folder = tmp_path / "one"
    command = [SCRIPT, "train", SMOKE, "--data", flow_folder, "--out", folder, "--set", "training.updates=1000000"]
    status, error = interrupt(command, (folder / "checkpoint").exists)
    assert status == 130
    assert "Interrupted" in error
    assert load_model(folder / "checkpoint").num_parameters > 0
    shutil.rmtree(folder)


def test_a_second_run_on_the_same_folder_is_refused(cconv, own_run):
    before = (own_run / "state.json").read_bytes()
    with RunFolder(own_run).locked():
        assert_one_clear_line(cconv("study", "resume", own_run), "another run works in this folder")
        extend = ("study", "extend", own_run, "--stage", "random", "--trials", "2")
        assert_one_clear_line(cconv(*extend), "another run works in this folder")
    assert (own_run / "state.json").read_bytes() == before


def test_only_a_search_can_be_extended(cconv, own_run):
    extend = ("study", "extend", own_run, "--stage", "finalists", "--trials", "2")
    assert_one_clear_line(cconv(*extend), "no search 'finalists' to extend", "random, adaptive")


def test_a_finished_study_has_nothing_left_to_resume(cconv, own_run):
    before = (own_run / "rungs.json").read_bytes()
    status, out, _ = cconv("study", "resume", own_run)
    assert status == 0
    assert "Study finished" in out
    assert (own_run / "rungs.json").read_bytes() == before


def test_a_run_of_another_version_is_refused_and_left_alone(cconv, finished_run, tmp_path):
    shutil.copytree(finished_run, tmp_path / "old")
    study = json.loads((tmp_path / "old" / "study.json").read_text())
    (tmp_path / "old" / "study.json").write_text(json.dumps(study | {"format": 1}))
    for command in (("study", "status"), ("study", "resume"), ("report",)):
        assert_one_clear_line(cconv(*command, tmp_path / "old"), "format 1", "run the study again")


def test_a_space_whose_baseline_is_too_expensive_is_refused(cconv, flow_folder, tmp_path):
    space = (SMOKE.parents[1] / "search_spaces" / "smoke.toml").read_text()
    cap = next(line for line in space.splitlines() if line.startswith("max_flops_per_particle"))
    (tmp_path / "space.toml").write_text(space.replace(cap, "max_flops_per_particle = 10"))
    settings = ("--set", f"search.space={tmp_path / 'space.toml'}")
    outcome = cconv("study", "run", SMOKE, "--data", flow_folder, *settings, "--out", tmp_path / "run")
    assert_one_clear_line(outcome, "its baseline costs", "raise the cap")
    assert not (tmp_path / "run").exists()


def test_a_study_all_of_whose_finalists_failed_ends_in_status_1_with_the_reason(cconv, finished_run, tmp_path):
    folder = tmp_path / "run"
    shutil.copytree(finished_run, folder)
    for stage in ("finalists", "ablation", "select"):
        (folder / "stages" / f"{stage}.json").unlink()
    for outcome in folder.glob("finalists/*/*/outcome.json"):
        outcome.write_text(json.dumps({"outcome": "failed", "reason": "out of memory"}))
    status, _, error = cconv("study", "resume", folder)
    assert status == 1
    last = error.splitlines()[-1]
    assert last.startswith(f"cconv: {folder}: no finalist finished its training (")
    assert "out of memory" in last
    assert json.loads((folder / "state.json").read_text()) == {"state": "failed", "stage": "finalists"}
