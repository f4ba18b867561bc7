"""SIGKILL at random times, again and again: what was finished stays byte by byte, and nothing is left behind.

A process is known by what it cannot put off together: the mark in its environment, its session, and the folder for
temporary files in its arguments, its working folder or its open files. (Agents of Ray write their titles over their
environment and arguments.) A port belongs to a process, so that where no process is left no port is.
"""

import getpass
import itertools
import os
import random
import shutil
import subprocess
import tempfile
import time
import uuid
from contextlib import contextmanager
from pathlib import Path

import psutil
import pytest
from conftest import SCRIPT
from processes import PATIENCE, kill_tree
from studies import write_search

from cconv.study.records.run_folder import RunFolder

KILLS = int(os.environ.get("CCONV_KILLS", "50"))
ENDS_BY_ITSELF = 120  # seconds within which what a killed process started notices it; agents of Ray need 60
SHARED_MEMORY = Path("/dev/shm")
OF_AN_ATTEMPT = ("attempt", "hanging.txt")  # may outlive a killed training that had come to its end
TORCH_CACHE = f"torchinductor_{getpass.getuser()}"  # an empty folder of torch, made by any training
MARK = "CCONV_TEST_MARK"

pytestmark = [pytest.mark.slow, pytest.mark.timeout(4 * 3600)]


class Victim:
    """Runs commands whose processes are known, also those that outlive their parents, and kills them.

    Args:
        place: Folder for temporary files, of these commands alone.
        seed: Of the times of the kills, and of whether only the command's own process or all of them are killed.
    """

    def __init__(self, place, seed):
        self.place, self.mark, self.kills, self.sessions = place, uuid.uuid4().hex, 0, set()
        self._random = random.Random(seed)

    def run(self, command, longest):
        """Run a command for a random time; whether it came to its end before it was killed."""
        environment = os.environ | {MARK: self.mark, "TMPDIR": str(self.place)}
        streams = {"stdout": subprocess.DEVNULL, "stderr": subprocess.PIPE, "text": True}
        with subprocess.Popen(command, env=environment, start_new_session=True, **streams) as process:
            self.sessions.add(process.pid)
            try:
                process.wait(self._random.uniform(0, longest))
                assert process.returncode == 0, process.stderr.read()
                return True
            except subprocess.TimeoutExpired:
                self.kills += 1
                process.kill() if self._random.random() < 0.5 else kill_tree(process.pid)
        self.await_end()
        return False

    def fresh_folders(self, parent):
        """Another folder to write to, until there were enough kills."""
        for number in itertools.count():
            if self.kills >= KILLS:
                return
            yield parent / f"killed_{number}"

    def await_end(self):
        """Wait until no process of the commands is left."""
        deadline = time.monotonic() + ENDS_BY_ITSELF
        while (left := list(self._processes())) and time.monotonic() < deadline:
            time.sleep(0.1)
        assert left == []

    def _processes(self):
        for process in psutil.process_iter():
            try:
                if process.status() != psutil.STATUS_ZOMBIE and self._owns(process):
                    yield process
            except (psutil.NoSuchProcess, psutil.AccessDenied, OSError):  # it ended meanwhile
                continue

    def _owns(self, process):
        if os.getsid(process.pid) in self.sessions or process.environ().get(MARK) == self.mark:
            return True
        links = [Path(f"/proc/{process.pid}/cwd"), *Path(f"/proc/{process.pid}/fd").iterdir()]
        return any(str(self.place) in name for name in [*process.cmdline(), *map(os.readlink, links)])


@contextmanager
def victim(seed):
    """A `Victim` of which nothing is left in the end, in temporary folders or shared memory."""
    place = Path(tempfile.mkdtemp(prefix="k-", dir="/tmp"))  # short, for Ray's sockets
    before = set(SHARED_MEMORY.iterdir())
    try:
        each = Victim(place, seed)
        yield each
        each.await_end()
        assert [path for path in place.rglob("*") if path.name != TORCH_CACHE] == []
        new = set(SHARED_MEMORY.iterdir()) - before
        time.sleep(5)  # other programs may hold some for a moment
        assert {path for path in new if path.exists()} == set()
    finally:
        shutil.rmtree(place)


def finished_trials(folder):
    """Every file of the trials that ended."""
    return {
        path.relative_to(folder): path.read_bytes()
        for outcome in folder.glob("trials/*/outcome.json")
        for path in outcome.parent.rglob("*")
        if path.is_file() and path.name not in OF_AN_ATTEMPT
    }


def seconds_of(command):
    start = time.monotonic()
    subprocess.run(command, check=True, capture_output=True, timeout=PATIENCE)
    return time.monotonic() - start


def test_a_study_that_is_killed_again_and_again_keeps_every_finished_trial(flow_folder, tmp_path):
    study = write_search(tmp_path, "killed", concurrency=2, random=4, adaptive=2)
    begin = [SCRIPT, "study", "run", study, "--data", flow_folder, "--set", "training.updates=12", "--out"]
    longest = seconds_of([*begin, tmp_path / "whole"])
    outcomes = [(record.id, record.parameters) for record in RunFolder(tmp_path / "whole").trials_of("random")]
    with victim(seed=0) as killed:
        for folder in killed.fresh_folders(tmp_path):
            ended, before = killed.run([*begin, folder], longest), {}
            while not ended:
                before |= finished_trials(folder)
                command = [SCRIPT, "study", "resume", folder] if (folder / "study.json").exists() else [*begin, folder]
                ended = killed.run(command, longest if killed.kills < KILLS else PATIENCE)
                assert before.items() <= finished_trials(folder).items()
            run = RunFolder(folder)
            assert run.read("state.json")["state"] == "finished"
            assert [(record.id, record.parameters) for record in run.trials_of("random")] == outcomes
            assert list(folder.rglob(".*")) == []


def test_data_that_are_killed_again_and_again_keep_every_finished_trajectory(tmp_path):
    settings = ["--size", "small", "--trajectories", "6", "--frames", "3", "--workers", "2"]
    command = [SCRIPT, "data", "generate", "taylor_green_2d", *settings, "--out"]
    longest = seconds_of([*command, tmp_path / "whole"])
    expected = {path.name: path.read_bytes() for path in (tmp_path / "whole").iterdir()}
    with victim(seed=1) as killed:
        for folder in killed.fresh_folders(tmp_path):
            unfinished, ended, before = folder.with_name(f"{folder.name}.unfinished"), False, {}
            while not ended:
                ended = killed.run([*command, folder], longest if killed.kills < KILLS else PATIENCE)
                ended = ended or (folder.exists() and not unfinished.exists())  # killed after all was done
                now = {path.name: path.stat().st_ino for path in unfinished.glob("*.safetensors")}
                assert ended or before.items() <= now.items()  # none was computed a second time
                before = now
            assert {path.name: path.read_bytes() for path in folder.iterdir()} == expected
            assert not unfinished.exists()
