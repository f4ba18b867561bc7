"""The reference stage spends what a search spent by another rule."""

import pytest

from cconv.study.records.trials import TrialRecord
from cconv.study.stages.reference import kept_at_same_budget

RUNGS = [10, 30, 90]


def trial(number, *errors):
    """A trial with an error at each rung that it reached."""
    log = [{"updates": updates, "valid_error": error} for updates, error in zip(RUNGS, errors, strict=False)]
    outcome = "completed" if len(errors) == len(RUNGS) else "stopped"
    return TrialRecord(
        id=f"random_{number:04d}", stage="random", parameters={}, config={}, log=log, outcome=outcome, reason=""
    )


@pytest.mark.parametrize("first_errors", [[0.1, 0.2, 0.3, 0.4, 0.5], [0.5, 0.4, 0.1, 0.2, 0.3]])
def test_the_best_at_the_first_rung_are_kept_whatever_became_of_them(first_errors):
    later = [(0.9, 0.9), (0.1, 0.1), (0.5,), (), ()]
    records = [
        trial(number, first, *rest) for number, (first, rest) in enumerate(zip(first_errors, later, strict=True))
    ]
    kept = kept_at_same_budget(records, RUNGS)
    spent = 90 + 90 + 30 + 10 + 10
    assert len(kept) == (spent - 5 * 10) // 80 == 2
    assert sorted(record.error_at(10) for record in kept) == [0.1, 0.2]
    assert kept == [record for record in records if record in kept]


def test_one_trial_is_kept_however_little_was_spent():
    assert [record.id for record in kept_at_same_budget([trial(0, 0.3), trial(1, 0.2)], RUNGS)] == ["random_0001"]


def test_a_trial_without_an_error_at_the_first_rung_is_not_kept():
    assert [record.id for record in kept_at_same_budget([trial(0), trial(1, 0.2)], RUNGS)] == ["random_0001"]
    assert kept_at_same_budget([trial(0)], RUNGS) == []
