"""A study on a cluster of two Ray nodes, one of which is killed during the search."""

import json
import os
import shutil
import socket
import subprocess
import tempfile
import time
from contextlib import contextmanager
from pathlib import Path

import optuna
import pytest
from conftest import SCRIPT
from outcomes import assert_one_clear_line
from processes import PATIENCE, kill_tree, names
from studies import write_search

from cconv.study.records.run_folder import RunFolder
from cconv.study.running.optuna_mirror import open_storage

pytestmark = pytest.mark.slow


@pytest.fixture
def study_file(tmp_path):
    return write_search(tmp_path, "clustered", concurrency=2, random=6, adaptive=2)


@pytest.fixture
def token(tmp_path, monkeypatch):
    """A token of a cluster, in a file that the environment names."""
    path = tmp_path / "auth_token"
    path.touch(mode=0o600)
    path.write_text("a" * 64)
    monkeypatch.setenv("RAY_AUTH_TOKEN_PATH", str(path))
    return path


@pytest.fixture
def nodes(token):
    """Address of a cluster, and the process of the second of its two nodes with a core each."""
    address = f"127.0.0.1:{free_port()}"
    head = ["--head", f"--port={address.partition(':')[2]}", "--include-dashboard=false"]
    with node(*head, "--dashboard-agent-listen-port=0"), node(f"--address={address}") as second:
        yield address, second


@contextmanager
def node(*arguments):
    settings = ("--block", "--num-cpus=1", "--object-store-memory=100000000", "--disable-usage-stats")
    ports = ("--min-worker-port=0", "--max-worker-port=0")  # any: two nodes share this machine
    folder = Path(tempfile.mkdtemp(prefix="ray_"))  # short, as names of sockets must be
    printed = folder / "printed.txt"
    with printed.open("w") as file:
        process = subprocess.Popen(
            [SCRIPT.parent / "ray", "start", *arguments, *settings, *ports, f"--temp-dir={folder}"],
            env=os.environ | {"RAY_AUTH_MODE": "token"},
            stdout=file,
            stderr=subprocess.STDOUT,
        )
    try:
        wait_until(lambda: "Ray runtime started" in printed.read_text(), process, said=printed)
        yield process
    finally:
        kill_tree(process.pid)
        process.wait()
        shutil.rmtree(folder, ignore_errors=True)


def free_port():
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        return free.getsockname()[1]


def wait_until(holds, *processes, said=None, timeout=PATIENCE):
    deadline = time.monotonic() + timeout
    while not holds():
        assert all(process.poll() is None for process in processes), said and said.read_text()
        assert time.monotonic() < deadline, "nothing happened in time"
        time.sleep(0.02)


def logs(folder):
    return {log.parent.name: log.read_text().splitlines() for log in folder.glob("trials/*/log.jsonl")}


def is_training(process):
    return any(title.startswith("ray::ImplicitFunc") for title in names(process.pid))


@contextmanager
def started(command):
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)
    try:
        yield process
    finally:
        kill_tree(process.pid)
        process.communicate()


def test_a_study_survives_the_death_of_a_node_without_losing_a_trial(nodes, study_file, flow_folder, tmp_path):
    address, second = nodes
    folder = tmp_path / "run"
    command = [SCRIPT, "study", "run", study_file, "--data", flow_folder, "--out", folder, "--address", address]
    with started(command) as study:
        wait_until(lambda: sum(map(len, logs(folder).values())) >= 8 and is_training(second), study, second)
        before = logs(folder)
        kill_tree(second.pid)
        _, errors = study.communicate(timeout=PATIENCE)
    assert study.returncode == 0, errors
    assert_whole(folder)
    after = logs(folder)
    for trial, entries in before.items():  # kept to the second, so not trained again; the last may have been cut short
        kept = entries[:-1]
        assert after[trial][: len(kept)] == kept


def assert_whole(folder):
    """All trials ended as a search ends them, with every evaluation on the way; so say the rungs and Optuna."""
    run = RunFolder.open(folder)
    records = run.trials()
    assert len(records) == 8
    for record in records:
        assert record.outcome in ("completed", "stopped", "diverged"), record.reason
        assert [entry["updates"] for entry in record.log] == list(range(4, record.log[-1]["updates"] + 1, 4))
    rungs = json.loads((folder / "rungs.json").read_text())
    for stage, entries in rungs.items():
        for rung in entries:
            reached = {
                record.id: entry["valid_error"]
                for record in run.trials_of(stage)
                for entry in record.log
                if entry["updates"] == rung["updates"]
            }
            assert rung["recorded"] == reached
    storage = open_storage(folder / "optuna.journal")
    states = [trial.state for trial in optuna.load_study(study_name="clustered", storage=storage).trials]
    assert len(states) == 8
    assert all(state.is_finished() for state in states)


@pytest.mark.parametrize(("given", "said"), [(None, "no token for this cluster"), ("b" * 64, "with the same token")])
def test_a_cluster_whose_token_one_lacks_is_one_line(nodes, token, given, said, study_file, flow_folder, tmp_path):
    address, _ = nodes
    token.unlink() if given is None else token.write_text(given)
    folder = tmp_path / "run"
    command = [SCRIPT, "study", "run", study_file, "--data", flow_folder, "--out", folder, "--address", address]
    environment = os.environ | {"HOME": str(tmp_path)}
    run = subprocess.run(command, capture_output=True, text=True, timeout=PATIENCE, env=environment)
    last = run.stderr.splitlines(keepends=True)[-1]
    assert_one_clear_line((run.returncode, run.stdout, last), f"--address {address}", said)
    assert not folder.exists()


def test_a_cluster_that_is_not_there_is_one_line_and_the_same_command_works_later(study_file, flow_folder, tmp_path):
    folder = tmp_path / "run"
    command = [SCRIPT, "study", "run", study_file, "--data", flow_folder, "--out", folder, "--address", "127.0.0.1:1"]
    run = subprocess.run(command, capture_output=True, text=True, timeout=PATIENCE)
    last = run.stderr.splitlines(keepends=True)[-1]
    assert_one_clear_line((run.returncode, run.stdout, last), "--address 127.0.0.1:1", "ray start --head")
    assert not folder.exists()
