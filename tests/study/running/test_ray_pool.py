"""What the pool makes of trainings that fail, hang, die, take too long or fill the disk; the others go on."""

import signal
import subprocess
import sys
from types import SimpleNamespace
from typing import NamedTuple

import pytest
import ray
import troubles
from processes import PATIENCE
from troubles import BrokenJudge, jobs_in, study_of, trained_in, troubled_problem

from cconv.errors import ConfigError
from cconv.study.declared.configuration import TrainingConfig
from cconv.study.records.trials import TrialFolder
from cconv.study.running.event_file import EVENT_FILE
from cconv.study.running.ray_pool import STARTS, RayPool, _Driver, _start, ray_pool
from cconv.study.running.trial_queue import TrialQueue

pytestmark = pytest.mark.integration

ray.cloudpickle.register_pickle_by_value(troubles)  # workers know no tests


@pytest.fixture(scope="module")
def problem(flow_folder):
    return troubled_problem(flow_folder)


@pytest.fixture(scope="module")
def cores(flow_folder, tmp_path_factory):
    """A Ray of two cores that the tests share."""
    with ray_pool(study_of(flow_folder), None, tmp_path_factory.mktemp("ray")):
        yield


@pytest.fixture
def train(cores, problem, flow_folder, tmp_path):
    """Train models of some initial weights with some settings; gives how each ended and why."""

    def run(seeds, *settings, judge=None):
        study = study_of(flow_folder, *settings)
        return trained_in(RayPool(study, problem, tmp_path / "ray"), study, tmp_path, seeds, judge)

    return run


def test_one_that_fails_is_recorded_with_its_reason_and_others_go_to_the_full_budget(train, tmp_path):
    assert train([0, 1, 10]) == {0: ("completed", ""), 1: ("failed", "no such model"), 10: ("completed", "")}
    for seed in (0, 10):
        folder = tmp_path / f"trial_{seed}"
        assert [entry["updates"] for entry in TrialFolder(folder).log()] == [1, 2]
        files = {"config.json", "log.jsonl", EVENT_FILE, "outcome.json", "checkpoint"}
        assert {path.name for path in folder.iterdir()} == files


@pytest.mark.slow
def test_one_whose_process_dies_is_given_up_and_one_that_hangs_is_ended_at_its_limit(train, tmp_path):
    ends = train([3, 4, 0], "search.trial_seconds=15")
    assert ends[0] == ("completed", "")
    assert ends[3] == ("failed", "its process or node died 3 times")
    outcome, reason = ends[4]
    assert outcome == "failed"
    assert "hung and was ended after 30 seconds" in reason
    assert "in hang" in (tmp_path / "trial_4" / "hanging.txt").read_text()


@pytest.mark.slow
def test_one_that_takes_too_long_is_stopped_and_the_record_names_the_limit(train):
    endless = [f"{key}=1000000" for key in ("training.updates", "training.evaluate_every", "search.grace_updates")]
    reason = "it trained longer than its limit of 10 seconds"
    assert train([0], *endless, "search.trial_seconds=10") == {0: ("stopped", reason)}


def test_a_full_disk_ends_the_run_in_one_line_and_gives_no_training_an_outcome(train, tmp_path):
    with pytest.raises(ConfigError, match=r"trial_2: .*No space left on device.*make room.*resume") as caught:
        train([2])
    assert "\n" not in str(caught.value)
    assert not TrialFolder(tmp_path / "trial_2").ended


def test_an_error_of_the_judge_ends_the_run_as_it_is_and_gives_no_training_an_outcome(train, tmp_path):
    with pytest.raises(OSError, match="rungs.json"):
        train([0], judge=BrokenJudge())
    assert not TrialFolder(tmp_path / "trial_0").ended


@pytest.fixture
def slow_ray(monkeypatch, tmp_path):
    """Make Ray come up at a given try only; what earlier ones leave behind are processes that it started."""
    left = []

    def come_up_at(number):
        def init(*_, _temp_dir, **settings):
            if len(left) + 1 < number:
                left.append(subprocess.Popen([sys.executable, "-c", "import time; time.sleep(1000)", _temp_dir]))
                raise Exception("The current node timed out during startup.")

        monkeypatch.setattr("cconv.study.running.ray_pool.ray", SimpleNamespace(init=init, shutdown=lambda: None))
        return left

    yield come_up_at
    for process in left:
        process.kill()
        process.wait()


def test_a_ray_that_does_not_come_up_in_time_is_started_again_and_leaves_nothing(slow_ray, tmp_path):
    left = slow_ray(STARTS)
    _start(1, 0, tmp_path)
    assert len(left) == STARTS - 1
    assert all(process.wait(PATIENCE) == -signal.SIGKILL for process in left)


def test_a_ray_that_never_comes_up_is_one_line(slow_ray, tmp_path):
    slow_ray(STARTS + 1)
    with pytest.raises(ConfigError, match="Ray does not start on this machine .*timed out") as caught:
        _start(1, 0, tmp_path)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("address", ["127.0.0.1:1", "no-such-host.invalid:6379", "nonsense"])
def test_a_cluster_that_is_not_there_is_one_line(address, cores, flow_folder, tmp_path):
    missing = pytest.raises(ConfigError, match=f"--address {address}.*ray start --head")
    with missing as caught, ray_pool(study_of(flow_folder), None, tmp_path, address):
        pass
    assert "\n" not in str(caught.value)


class NamedTrial(NamedTuple):
    """A trial of Ray as its callbacks see it."""

    name: str
    config: dict

    def __str__(self):
        return self.name


def test_one_whose_process_died_before_it_wrote_its_configuration_has_a_record(tmp_path):
    """As on a machine so busy that a process is ended at its limit before it has begun."""
    (job,) = jobs_in(tmp_path, [7])
    queue = TrialQueue([job], TrainingConfig(), None, [])
    assert queue.next() is job
    _Driver(queue, "random").on_trial_error(0, [], NamedTrial(job.name, {"job": job}))
    record = TrialFolder(job.folder).read()
    assert (record.stage, record.outcome) == ("random", "failed")
    assert record.reason.startswith("its process or node died")
    assert record.config["num_parameters"] is None
