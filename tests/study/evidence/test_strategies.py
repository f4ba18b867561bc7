"""Replayed strategies: counts by hand, what they have in common, and an oracle of Ray's rule."""

import numpy as np
import pytest

from cconv.study.evidence.strategies import (
    best_so_far,
    compare_strategies,
    learning_curves,
    replay_asha,
    replay_little_each,
    spent_updates,
)
from cconv.study.records.found import SpentUpdates
from cconv.study.records.trials import TrialRecord

RUNGS = [10, 30, 90]


@pytest.fixture
def curves():
    rng = np.random.default_rng(0)
    full = 10 ** rng.normal(-2, 0.5, 24)
    return {
        f"{number}": [
            (updates, error * 10 ** rng.normal(0, 0.3 * (90 - updates) / 90)) for updates in (*RUNGS[:2], 60, 90)
        ]
        for number, error in enumerate(full)
    }


def trial(name, log, outcome="completed"):
    log = [{"updates": updates, "valid_error": error} for updates, error in log]
    return TrialRecord(id=name, stage="random", parameters={}, config={}, log=log, outcome=outcome, reason="")


def ray_rule(curves, order):
    """Updates and best error by the stopping rule of Ray's bracket, written out."""
    recorded, spent, finished = {updates: [] for updates in RUNGS}, 0, []
    for name in order:
        for updates, error in curves[name]:
            if updates in RUNGS[:-1]:
                before = recorded[updates]
                stops = bool(before) and -error < np.nanpercentile([-value for value in before], (1 - 1 / 3) * 100)
                before.append(error)
                if stops:
                    break
        else:
            finished.append(error)
        spent += updates
    return spent, min(finished)


def test_asha_stops_as_ray_does(curves):
    rng = np.random.default_rng(1)
    for _ in range(20):
        order = list(rng.permutation(list(curves)))
        replay = replay_asha(curves, RUNGS, 3, order)
        assert (replay.updates, replay.best_error) == ray_rule(curves, order)


def test_asha_counts_by_hand():
    curves = {"a": [(10, 2.0), (90, 1.0)], "b": [(10, 3.0), (90, 0.1)], "c": [(10, 1.0), (90, 0.5)]}
    replay = replay_asha(curves, [10, 90], 3, ["a", "b", "c"])
    assert (replay.updates, replay.best_error) == (90 + 10 + 90, 0.5)


def test_a_little_of_each_counts_by_hand():
    curves = {"a": [(10, 2.0), (90, 1.0)], "b": [(10, 3.0), (90, 0.1)], "c": [(10, 1.0), (90, 0.5)]}
    replay = replay_little_each(curves, 10, 2)
    assert (replay.updates, replay.best_error) == (90 + 90 + 10, 0.5)
    everything = replay_little_each(curves, 10, 3)
    assert (everything.updates, everything.best_error) == (270, 0.1)


def test_what_stops_spends_less_and_finds_no_better(curves):
    entries = compare_strategies(curves, RUNGS, 3, draws=100)
    asha, *little, everything = entries
    assert (everything.strategy, everything.share, everything.regret) == ("no_stopping", 1.0, 1.0)
    assert [entry.updates_each for entry in little] == RUNGS[:-1]
    for entry in [asha, *little]:
        assert entry.share < 1
        assert entry.regret >= 1
        assert entry.regret_range95[0] >= 1
    assert little[0].share <= asha.share


def test_curves_that_were_not_measured_at_every_rung_do_not_count(curves):
    assert compare_strategies(curves | {"x": [(5, 1.0), (90, 1e-9)]}, RUNGS, 3, draws=20) == compare_strategies(
        curves, RUNGS, 3, draws=20
    )
    assert compare_strategies({}, RUNGS, 3) == []


def test_curves_are_those_of_completed_trials_with_finite_errors():
    records = [trial("a", [(10, 0.5)]), trial("b", [(10, None), (90, 1.0)]), trial("c", [(10, 0.1)], "stopped")]
    assert learning_curves(records) == {"a": [(10, 0.5)]}


def test_every_update_that_was_spent_counts():
    records = [trial("a", [(10, 0.5), (90, 0.2)]), trial("b", [(10, 0.1)], "stopped"), trial("c", [], "failed")]
    assert spent_updates(records, 90) == SpentUpdates(updates=100, full_updates=270, share=100 / 270)


def test_the_best_so_far_falls_and_only_completed_trials_lower_it():
    logs = [("stopped", 0.01), ("completed", 0.3), ("completed", 0.5), ("diverged", None), ("completed", 0.1)]
    records = [trial(f"{number}", [(10, error)], outcome) for number, (outcome, error) in enumerate(logs)]
    assert best_so_far(records) == [(20, 0.3), (30, 0.3), (40, 0.3), (50, 0.1)]
