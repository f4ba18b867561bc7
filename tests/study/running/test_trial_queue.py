"""The queue hands out trainings, judges and ends them; over the records of a killed run it goes on as it would."""

import pytest

from cconv.study.declared.configuration import TrainingConfig
from cconv.study.declared.study_file import rungs_up_to
from cconv.study.records.run_folder import RunFolder
from cconv.study.records.rungs import RungFile
from cconv.study.running.trial_queue import Job, NothingStops, StopsByRungs, TrialQueue

FULL = 27
RUNGS = rungs_up_to(FULL, 3, 3)


class Watcher:
    """Writes down what it sees."""

    def __init__(self):
        self.seen = []

    def __getattr__(self, name):
        return lambda *arguments: self.seen.append((name, *arguments))


def entry(updates, error, diverged=False):
    return {"updates": updates, "valid_error": error, "seconds": 1.0, "diverged": diverged}


def job(run, number):
    name = f"random_{number:04d}"
    return Job(folder=run.trial(name).path, name=name, parameters={"number": number}, init_seed=0)


def asha(run, give_up_above=10.0):
    file = RungFile(run.path / "rungs.json")
    return StopsByRungs(file, "random", file.table("random", RUNGS, 3), give_up_above)


def queue(run, count=12, judge=None, observers=()):
    return TrialQueue(
        (job(run, number) for number in range(count)), TrainingConfig(updates=FULL), judge or asha(run), observers
    )


def error_of(number, updates):
    """Falling errors; trials differ by a fixed shuffle."""
    return (1 + (7 * number) % 12) / updates


class Killed(Exception):
    """The whole process tree is gone."""


def work(run, given, kill_after=None):
    """A single worker that logs an evaluation every three updates, as a trial does; killed after so many of them."""
    evaluations = 0
    while (taken := given.next()) is not None:
        folder = run.trial(taken.name)
        logged = folder.log()
        if not folder.started:
            folder.start({"stage": "random", "parameters": taken.parameters, "init_seed": 0})
        for updates in range(logged[-1]["updates"] + 3 if logged else 3, FULL + 1, 3):
            result = entry(updates, error_of(taken.parameters["number"], updates))
            folder.append(result)
            evaluations += 1
            if evaluations == kill_after:
                raise Killed
            goes_on = given.on_result(taken.name, result)
            if not goes_on or updates == FULL:
                given.on_end(taken.name, given.outcome_after(result))
                break


@pytest.fixture
def whole(tmp_path):
    run = RunFolder(tmp_path / "whole")
    work(run, queue(run))
    return run


def ends(run):
    folders = sorted((run.path / "trials").iterdir())
    return {folder.name: (folder / "outcome.json").read_text() for folder in folders}


def logs(run):
    return {folder.name: run.trial(folder.name).log() for folder in (run.path / "trials").iterdir()}


@pytest.mark.parametrize("kill_after", [1, 2, 9, 10, 11, 17, 25])
def test_a_killed_search_goes_on_to_the_same_rungs_logs_and_outcomes(tmp_path, whole, kill_after):
    """The kill comes between the log and the judgement of an evaluation, where most is at stake."""
    run = RunFolder(tmp_path / "killed")
    with pytest.raises(Killed):
        work(run, queue(run), kill_after)
    work(run, queue(run))
    assert run.read("rungs.json") == RunFolder(whole.path).read("rungs.json")
    assert ends(run) == ends(whole)
    assert logs(run) == logs(whole)


def test_more_trials_leave_those_that_ended_as_they_are(tmp_path, whole):
    before = ends(whole)
    work(whole, queue(whole, count=15))
    assert {name: end for name, end in ends(whole).items() if name in before} == before
    assert len(ends(whole)) == 15


def test_asha_spends_a_part_of_what_no_stopping_would(tmp_path):
    run = RunFolder(tmp_path)
    work(run, queue(run, count=60))
    spent = sum(log[-1]["updates"] for log in logs(run).values())
    assert spent < 0.5 * 60 * FULL


def test_an_error_that_is_not_finite_stops_a_trial_and_leaves_no_mark_in_a_rung(tmp_path):
    run = RunFolder(tmp_path)
    given = queue(run)
    first = given.next()
    assert not given.on_result(first.name, entry(3, None, diverged=True))
    assert given.outcome_after(entry(3, None, diverged=True)) == "diverged"
    assert not (tmp_path / "rungs.json").exists()


def test_a_hopeless_trial_is_stopped_even_as_the_first_at_its_rung(tmp_path):
    run = RunFolder(tmp_path)
    given = queue(run)
    assert not given.on_result(given.next().name, entry(3, 50.0))


def test_without_a_judge_all_go_to_the_end(tmp_path):
    run = RunFolder(tmp_path)
    work(run, queue(run, judge=NothingStops()))
    assert all('"completed"' in end for end in ends(run).values())


def test_a_training_whose_time_is_spent_is_completed_however_few_its_updates(tmp_path):
    """Also where the record of an earlier version says nothing of the time, only its updates count."""
    given = TrialQueue([], TrainingConfig(updates=FULL, cpu_seconds=10.0), NothingStops(), [])
    outcomes = [
        given.outcome_after(entry(3, 1.0) | spent) for spent in ({"cpu_seconds": 10.5}, {"cpu_seconds": 9.5}, {})
    ]
    assert outcomes == ["completed", "stopped", "stopped"]


def test_observers_hear_of_every_trial_from_its_start_to_its_end(tmp_path):
    run, watcher = RunFolder(tmp_path), Watcher()
    work(run, queue(run, count=1, observers=[watcher]))
    heard = [what for what, *_ in watcher.seen]
    assert heard == ["on_trial_start", *["on_trial_result"] * 9, "on_trial_end"]
