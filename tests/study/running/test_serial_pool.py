"""A pool in this process makes of trainings that fail, take too long or fill the disk what Ray's does."""

import errno

import pytest
import torch
from systems import problem as sound_problem
from troubles import BrokenJudge, end_of, jobs_in, study_of, trained_in, troubled_problem

from cconv.errors import ConfigError
from cconv.models.checkpoint import load_model
from cconv.study.records.trials import TrialFolder
from cconv.study.running.event_file import EVENT_FILE
from cconv.study.running.serial_pool import SerialPool
from cconv.study.running.trial_queue import TrialQueue


@pytest.fixture(scope="module")
def problem(flow_folder):
    return troubled_problem(flow_folder)


@pytest.fixture
def train(problem, flow_folder, tmp_path):
    """Train models of some initial weights with some settings; gives how each ended and why."""

    def run(seeds, *settings, judge=None):
        study = study_of(flow_folder, *settings)
        return trained_in(SerialPool(study, problem), study, tmp_path, seeds, judge)

    return run


def test_one_that_fails_is_recorded_with_its_reason_and_others_go_to_the_full_budget(train, tmp_path):
    assert train([0, 1, 10]) == {0: ("completed", ""), 1: ("failed", "no such model"), 10: ("completed", "")}
    for seed in (0, 10):
        folder = tmp_path / f"trial_{seed}"
        assert [entry["updates"] for entry in TrialFolder(folder).log()] == [1, 2]
        files = {"config.json", "log.jsonl", EVENT_FILE, "outcome.json", "checkpoint"}
        assert {path.name for path in folder.iterdir()} == files
    assert TrialFolder(tmp_path / "trial_1").read().config["stage"] == "random"


def test_one_that_takes_too_long_is_stopped_and_the_record_names_the_limit(train):
    endless = [f"{key}=1000000" for key in ("training.updates", "training.evaluate_every", "search.grace_updates")]
    reason = "it trained longer than its limit of 0.5 seconds"
    assert train([0, 10], *endless, "search.trial_seconds=0.5") == {0: ("stopped", reason), 10: ("stopped", reason)}


def test_one_that_the_judge_stops_is_recorded_as_stopped_and_the_next_begins(train, tmp_path):
    class Strict:
        def goes_on(self, name, entry):
            return name != "trial_0"

    assert train([0, 10], judge=Strict()) == {0: ("stopped", ""), 10: ("completed", "")}
    assert [entry["updates"] for entry in TrialFolder(tmp_path / "trial_0").log()] == [1]
    assert not list(tmp_path.rglob("attempt"))


def test_a_full_disk_ends_the_run_in_one_line_and_gives_no_training_an_outcome(train, tmp_path):
    with pytest.raises(ConfigError, match=r"trial_2: .*No space left on device.*make room.*resume") as caught:
        train([2, 0])
    assert "\n" not in str(caught.value)
    assert [end_of(tmp_path, seed) for seed in (2, 0)] == [None, None]


def test_an_error_of_the_judge_ends_the_run_as_it_is_and_gives_no_training_an_outcome(train, tmp_path):
    with pytest.raises(OSError, match="rungs.json") as caught:
        train([0], judge=BrokenJudge())
    assert caught.value.errno == errno.ENOSPC
    assert not TrialFolder(tmp_path / "trial_0").ended


def test_ctrl_c_leaves_a_usable_checkpoint_and_no_outcome_and_the_training_goes_on_later(train, tmp_path):
    class Impatient:
        def goes_on(self, name, entry):
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        train([0, 10], judge=Impatient())
    assert [end_of(tmp_path, seed) for seed in (0, 10)] == [None, None]
    assert load_model(tmp_path / "trial_0" / "checkpoint").num_parameters > 0
    assert not (tmp_path / "trial_0" / "attempt").exists()
    assert train([0, 10]) == {0: ("completed", ""), 10: ("completed", "")}
    assert [entry["updates"] for entry in TrialFolder(tmp_path / "trial_0").log()] == [1, 2]


def test_trainings_compute_on_one_thread_as_those_of_ray_do_and_threads_are_restored(generator, flow_folder, tmp_path):
    before, seen = torch.get_num_threads(), []

    class Watching:
        def goes_on(self, name, entry):
            seen.append(torch.get_num_threads())
            return True

    torch.set_num_threads(2)
    try:
        study = study_of(flow_folder)
        queue = TrialQueue(jobs_in(tmp_path, [0]), study.training, Watching(), [])
        SerialPool(study, sound_problem(generator, study.task.name)).run(queue, "random", study.training)
        assert (seen, torch.get_num_threads()) == ([1, 1], 2)
    finally:
        torch.set_num_threads(before)
