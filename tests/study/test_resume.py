"""A study that is interrupted, or whose whole process tree is killed, goes on to the records of one that was not."""

import json
import subprocess
import time

import pytest
from conftest import SCRIPT
from outcomes import assert_one_clear_line
from processes import PATIENCE, kill_tree
from studies import Silent, begin_search, write_search

from cconv.study.pipeline import run_study
from cconv.study.records.run_folder import RunFolder

TRIALS = {"concurrency": 1, "random": 5, "adaptive": 3}


@pytest.fixture(scope="module")
def study_file(tmp_path_factory):
    return write_search(tmp_path_factory.mktemp("studies"), "killed", **TRIALS)


@pytest.fixture(scope="module")
def whole(study_file, flow_folder, tmp_path_factory):
    """Run folder of the study, trained in this process from its beginning to its end."""
    run = begin_search(study_file, flow_folder, tmp_path_factory.mktemp("runs") / "whole")
    run_study(run, Silent(), serial=True)
    return run.path


def assert_same_records(folder, whole):
    """Configurations, rungs, outcomes and logs are the same, errors to the last bit; only times differ."""
    assert json.loads((folder / "rungs.json").read_text()) == json.loads((whole / "rungs.json").read_text())
    for ours, theirs in zip(RunFolder(folder).trials(), RunFolder(whole).trials(), strict=True):
        assert (ours.id, ours.parameters, ours.outcome) == (theirs.id, theirs.parameters, theirs.outcome)
        assert without_times(ours.log) == without_times(theirs.log)
    assert not list(folder.rglob("progress.safetensors"))


def without_times(log):
    times = ("seconds", "cpu_seconds")
    return [{key: value for key, value in entry.items() if key not in times} for entry in log]


class Impatient(Silent):
    """Presses Ctrl-C at the first evaluation of a trial, before it is judged."""

    def __init__(self, trial):
        self._trial = trial

    def on_trial_result(self, trial, entry):
        if trial == self._trial:
            raise KeyboardInterrupt


def test_an_interrupted_study_goes_on_to_the_records_of_one_that_was_not(study_file, whole, flow_folder, tmp_path):
    """Again and again, in the random search and in the adaptive one."""
    run = begin_search(study_file, flow_folder, tmp_path / "interrupted")
    for trial in ("random_0000", "random_0003", "adaptive_0000", "adaptive_0002"):
        with pytest.raises(KeyboardInterrupt):
            run_study(run, Impatient(trial), serial=True)
        assert run.read("state.json")["state"] == "interrupted"
        assert len(run.trial(trial).log()) == 1
    run_study(run, Silent(), serial=True)
    assert_same_records(run.path, whole)


@pytest.mark.slow
def test_ray_that_trains_one_at_a_time_leaves_the_records_of_a_serial_study(study_file, whole, flow_folder, tmp_path):
    command = [SCRIPT, "study", "run", study_file, "--data", flow_folder, "--out", tmp_path / "ray"]
    subprocess.run(command, check=True, capture_output=True, timeout=PATIENCE)
    assert_same_records(tmp_path / "ray", whole)


def evaluations(folder):
    return sum(len(log.read_text().splitlines()) for log in folder.glob("trials/*/log.jsonl"))


def kill_after(command, folder, count, timeout=PATIENCE):
    """Start a study in a process group of its own and kill all of it once so many evaluations are logged."""
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, start_new_session=True)
    deadline = time.monotonic() + timeout
    while evaluations(folder) < count and process.poll() is None and time.monotonic() < deadline:
        time.sleep(0.02)
    assert process.poll() is None, "the study ended before it could be killed"
    kill_tree(process.pid)
    process.wait()


@pytest.mark.slow
def test_a_killed_study_resumes_to_the_same_rungs_and_logs(cconv, study_file, whole, flow_folder, tmp_path):
    killed = tmp_path / "killed"
    run = (SCRIPT, "study", "run", study_file, "--data", flow_folder, "--out", killed)
    kill_after(run, killed, 11)
    before = {log.parent.name: len(log.read_text().splitlines()) for log in killed.glob("trials/*/log.jsonl")}
    assert_one_clear_line(cconv(*run[1:]), "exists already")
    finished = subprocess.run([SCRIPT, "study", "resume", killed], capture_output=True, text=True, timeout=PATIENCE)
    assert finished.returncode == 0, finished.stderr
    assert_same_records(killed, whole)
    assert all(len(record.log) >= before.get(record.id, 1) - 1 for record in RunFolder(killed).trials())
