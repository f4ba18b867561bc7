"""Generators in processes of their own: all run, what they raise arrives, nothing of theirs has a name in memory."""

import os
from pathlib import Path

import pytest
from generators import die, refuse, write

from cconv.data.side_by_side import side_by_side
from cconv.errors import ConfigError, DataError

pytestmark = pytest.mark.integration


def semaphores_with_a_name():
    """Those that this process has open and that stand in shared memory; other processes may have some too."""
    maps = Path("/proc/self/maps").read_text().splitlines()
    return {line.split()[-1] for line in maps if "/dev/shm/sem." in line and not line.endswith("(deleted)")}


def test_every_call_runs_to_its_end_in_as_many_processes_and_each_yield_is_told(tmp_path, capfd):
    calls = [(tmp_path, number, number) for number in range(5)]
    told = sum(1 for _ in side_by_side(write, calls, 2))
    assert told == sum(range(5))
    processes = {(tmp_path / str(number)).read_text() for number in range(5)}
    assert len(processes) == 2
    assert str(os.getpid()) not in processes
    assert not capfd.readouterr().err  # a worker that runs out of calls ends without a word


def test_what_a_call_raises_arrives():
    with pytest.raises(ConfigError, match="no such thing"):
        list(side_by_side(refuse, [()], 1))


def test_a_worker_that_is_ended_from_outside_is_told():
    with pytest.raises(DataError, match="ended from outside"):
        list(side_by_side(die, [()], 1))


def test_nothing_in_shared_memory_has_a_name_while_workers_run(tmp_path):
    """It would stay for ever where a kill ends all processes."""
    before = semaphores_with_a_name()
    running = side_by_side(write, [(tmp_path, number, 2) for number in range(2)], 2)
    next(running)
    assert semaphores_with_a_name() <= before
    running.close()
