"""Contract tests of what `cconv.study.asha` uses of Ray's private parts."""

from types import SimpleNamespace

import optuna
import pytest
from optuna.distributions import FloatDistribution
from optuna.trial import TrialState

from cconv.study.asha import RecordedASHA, RungAwareOptunaSearch
from cconv.study.records import read_json


class Trial(SimpleNamespace):
    """As much of a Ray trial as a scheduler sees."""

    def __str__(self):
        return self.name


SETTINGS = {"max_updates": 27, "grace_updates": 3, "reduction_factor": 3, "metric": "error", "give_up_above": 10.0}


@pytest.fixture
def scheduler(tmp_path):
    return RecordedASHA(tmp_path / "rungs.json", "random", **SETTINGS)


def feed(scheduler, name, *results, diverged=False):
    """Report (updates, error) pairs until the scheduler stops the trial; returns the last decision."""
    trial = Trial(trial_id=f"ray-{name}", name=name)
    scheduler.on_trial_add(None, trial)
    for updates, error in results:
        result = {"updates": updates, "error": error, "diverged": diverged}
        decision = scheduler.on_trial_result(None, trial, result)
        if decision == RecordedASHA.STOP:
            scheduler.on_trial_complete(None, trial, result)
            return decision
    return decision


def test_rungs_keep_the_best_third(scheduler):
    decisions = [feed(scheduler, f"t{error}", (3, error)) for error in (5.0, 4.0, 3.0, 6.0, 1.0)]
    assert decisions == ["CONTINUE", "CONTINUE", "CONTINUE", "STOP", "CONTINUE"]


def test_rungs_are_on_disk_after_every_result_by_our_names(scheduler, tmp_path):
    feed(scheduler, "random_0000", (3, 0.5), (9, 0.25))
    rungs = read_json(tmp_path / "rungs.json")["random"]
    assert [rung["updates"] for rung in rungs] == [3, 9, 27]
    assert rungs[0]["recorded"] == {"random_0000": 0.5}
    assert rungs[1]["recorded"] == {"random_0000": 0.25}


def test_a_diverged_trial_is_stopped_and_leaves_no_error_in_a_rung(scheduler, tmp_path):
    feed(scheduler, "good", (3, 0.5))
    assert feed(scheduler, "bad", (3, 1e9), diverged=True) == "STOP"
    assert read_json(tmp_path / "rungs.json")["random"][0]["recorded"] == {"good": 0.5}


def test_a_hopeless_trial_is_stopped_even_as_the_first_at_its_rung(scheduler, tmp_path):
    assert feed(scheduler, "hopeless", (3, 50.0)) == "STOP"
    assert read_json(tmp_path / "rungs.json")["random"][0]["recorded"] == {"hopeless": 50.0}


def test_stages_share_the_file(scheduler, tmp_path):
    feed(scheduler, "random_0000", (3, 0.5))
    other = RecordedASHA(tmp_path / "rungs.json", "adaptive", **SETTINGS)
    feed(other, "adaptive_0000", (3, 0.7))
    assert set(read_json(tmp_path / "rungs.json")) == {"random", "adaptive"}


@pytest.fixture
def search():
    return RungAwareOptunaSearch(
        {"x": FloatDistribution(0, 1)},
        metric="error",
        mode="min",
        sampler=optuna.samplers.RandomSampler(seed=0),
        max_updates=27,
    )


def test_optuna_hears_pruned_below_the_full_budget_and_complete_at_it(search):
    search.suggest("stopped")
    search.on_trial_complete("stopped", {"error": 0.5, "updates": 3, "diverged": False})
    search.suggest("full")
    search.on_trial_result("full", {"error": 0.4, "updates": 9})
    search.on_trial_complete("full", {"error": 0.2, "updates": 27, "diverged": False})
    search.suggest("crashed")
    search.on_trial_complete("crashed", error=True)
    stopped, full, crashed = search._ot_study.trials
    assert stopped.state == TrialState.PRUNED
    assert stopped.intermediate_values == {3: 0.5}
    assert (full.state, full.value, full.intermediate_values) == (TrialState.COMPLETE, 0.2, {9: 0.4})
    assert crashed.state == TrialState.FAIL


def test_diverging_at_the_full_budget_is_not_complete(search):
    search.suggest("late")
    search.on_trial_complete("late", {"error": 1e9, "updates": 27, "diverged": True})
    assert search._ot_study.trials[0].state == TrialState.PRUNED


def test_a_second_completion_changes_nothing(search):
    search.suggest("twice")
    for _ in range(2):
        search.on_trial_complete("twice", {"error": 0.5, "updates": 3, "diverged": False})
    assert search._ot_study.trials[0].intermediate_values == {3: 0.5}


def test_no_trial_is_left_running(search):
    for name in ("a", "b"):
        search.suggest(name)
        search.on_trial_complete(name, {"error": 1e9, "updates": 3, "diverged": True})
    assert all(trial.state.is_finished() for trial in search._ot_study.trials)
