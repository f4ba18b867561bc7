"""A study whose whole process tree is killed goes on to the rungs of one that was not."""

import json
import subprocess
import time

import pytest
from conftest import SCRIPT
from outcomes import assert_one_clear_line
from processes import PATIENCE, kill_tree
from studies import write_search

from cconv.study.records.run_folder import RunFolder


@pytest.fixture(scope="module")
def study_file(tmp_path_factory):
    return write_search(tmp_path_factory.mktemp("studies"), "killed", concurrency=1, random=5, adaptive=3)


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


def without_times(log):
    return [{key: value for key, value in entry.items() if key != "seconds"} for entry in log]


def test_a_killed_study_resumes_to_the_same_rungs_and_logs(cconv, study_file, flow_folder, tmp_path):
    whole, killed = tmp_path / "whole", tmp_path / "killed"
    run = (SCRIPT, "study", "run", study_file, "--data", flow_folder, "--out")
    subprocess.run([*run, whole], check=True, capture_output=True, timeout=PATIENCE)
    kill_after([*run, killed], killed, 11)
    before = {log.parent.name: len(log.read_text().splitlines()) for log in killed.glob("trials/*/log.jsonl")}
    assert_one_clear_line(cconv(*run[1:], killed), "exists already")
    finished = subprocess.run([SCRIPT, "study", "resume", killed], capture_output=True, text=True, timeout=PATIENCE)
    assert finished.returncode == 0, finished.stderr
    assert json.loads((killed / "rungs.json").read_text()) == json.loads((whole / "rungs.json").read_text())
    for ours, theirs in zip(RunFolder(killed).trials(), RunFolder(whole).trials(), strict=True):
        assert (ours.id, ours.parameters, ours.outcome) == (theirs.id, theirs.parameters, theirs.outcome)
        assert without_times(ours.log) == without_times(theirs.log)
        assert len(ours.log) >= before.get(ours.id, 1) - 1
    assert not list(killed.rglob("progress.safetensors"))
