import pytest
from summaries import finalist

from cconv.study.evidence.budget import budget_words, fall_at_the_end, still_falling
from cconv.study.records.found import BudgetPoint, Convergence
from cconv.study.records.trials import TrialRecord


def record(errors, every=10):
    log = [
        {"updates": every * number, "valid_error": error, "seconds": 1.0}
        for number, error in enumerate(errors, start=1)
    ]
    return TrialRecord(
        id="seed_1", stage="finalists", parameters={}, config={}, log=log, outcome="completed", reason=""
    )


def point(name, updates, error):
    return BudgetPoint(id=name, updates=updates, valid_error=error, by_seed={"seed_1": error}, train_seconds=1.0)


def test_the_fall_is_that_of_the_best_error_in_the_last_quarter_of_the_updates():
    assert fall_at_the_end([record([1.0, 0.8, 0.8, 0.4])]) == pytest.approx(0.5)
    assert fall_at_the_end([record([1.0, 0.8, 0.8, 0.4]), record([0.5, 0.4, 0.4, 0.4])]) == pytest.approx(0.25)


def test_an_error_that_rises_at_the_end_does_not_fall():
    assert fall_at_the_end([record([1.0, 0.5, 0.6, 0.7])]) == 0


def test_what_was_measured_once_says_nothing_of_a_fall():
    assert fall_at_the_end([record([0.3], every=0)]) is None
    assert fall_at_the_end([record([0.3])]) is None


@pytest.mark.parametrize(("errors", "falls"), [((1.0,), True), ((1.0, 0.94), True), ((1.0, 0.96), False)])
def test_a_gain_within_the_margin_is_none(errors, falls):
    assert still_falling([point("a", number, error) for number, error in enumerate(errors)], 0.05) == falls


def test_the_words_name_both_budgets_and_whether_the_error_still_falls():
    ends = [point("baseline", 162, 0.57), point("baseline_after_6000", 6000, 0.166)]
    found = {"baseline": Convergence(points=ends, still_falling=True)}
    words = budget_words([], found, 0.05)
    assert "162 updates limits the validation error of baseline to 0.57: after 6,000 updates it is 0.166" in words
    assert "still falling" in words
    assert "more updates do not lower it" in budget_words(
        [], {"baseline": Convergence(points=ends, still_falling=False)}, 0.05
    )


def test_a_finalist_whose_error_was_still_falling_is_named_unless_a_larger_budget_tells_more():
    entries = [
        finalist("baseline", updates=162, fall_at_the_end=0.2),
        finalist("fitted", updates=0, fall_at_the_end=None),
        finalist("flat", updates=162, fall_at_the_end=0.01),
        finalist("steep", updates=162, fall_at_the_end=0.3),
    ]
    found = {
        "baseline": Convergence(
            points=[point("baseline", 162, 0.5), point("baseline_after_600", 600, 0.4)], still_falling=False
        )
    }
    words = budget_words(entries, found, 0.05)
    assert "steep (by 30% in the last quarter of its 162 updates)" in words
    assert "flat" not in words
    assert "fitted" not in words
    assert "the error of baseline (" not in words


def test_nothing_is_said_where_no_budget_decided():
    assert budget_words([finalist("flat", updates=162, fall_at_the_end=0.0)], {}, 0.05) == ""
