"""Rung audit: measures that agree with scipy, laws of what they mean, and verdicts on known curves."""

import numpy as np
import pytest
import scipy.stats

from cconv.study.evidence.rung_audit import audit_rungs, rung_measures, spearman_interval
from cconv.study.records.trials import TrialRecord


@pytest.fixture
def rng():
    return np.random.default_rng(0)


def trial(name, errors, outcome="completed"):
    log = [{"updates": updates, "valid_error": error} for updates, error in errors.items()]
    return TrialRecord(id=f"{name}", stage="random", parameters={}, config={}, log=log, outcome=outcome, reason="")


def trials(rng, noise, count=32):
    full = 10 ** rng.normal(-2, 0.5, count)
    at_rung = full * 10 ** rng.normal(0, noise, count)
    return [
        trial(number, {10: early, 90: late}) for number, (early, late) in enumerate(zip(at_rung, full, strict=True))
    ]


def test_an_error_counts_where_it_was_measured():
    record = trial("a", {10: 0.5, 30: None})
    assert [record.error_at(updates) for updates in (10, 20, 30)] == [0.5, None, None]


def test_the_same_order_is_perfect_and_the_opposite_one_is_not():
    errors = np.arange(1.0, 13.0)
    same = rung_measures(errors, errors**2, top=3, kept=4)
    assert same == pytest.approx(
        {"spearman": 1, "kendall": 1, "crossing_rate": 0, "recall": 1, "survival": 1, "regret": 1}
    )
    turned = rung_measures(-errors, errors, top=3, kept=4)
    assert turned == pytest.approx(
        {"spearman": -1, "kendall": -1, "crossing_rate": 1, "recall": 0, "survival": 0, "regret": 12}
    )


def test_the_crossing_rate_is_that_of_kendall(rng):
    at_rung, at_full = rng.normal(size=(2, 20))
    measures = rung_measures(at_rung, at_full, top=3, kept=6)
    assert measures["crossing_rate"] == pytest.approx((1 - measures["kendall"]) / 2)
    assert measures["spearman"] == pytest.approx(
        scipy.stats.pearsonr(at_rung.argsort().argsort(), at_full.argsort().argsort())[0]
    )


def test_the_scale_of_errors_changes_nothing_but_the_regret(rng):
    at_rung, at_full = np.exp(rng.normal(size=(2, 20)))
    measures = rung_measures(at_rung, at_full, top=3, kept=6)
    scaled = rung_measures(at_rung**3, at_full**2, top=3, kept=6)
    assert scaled.pop("regret") == pytest.approx(measures.pop("regret") ** 2)
    assert scaled == pytest.approx(measures)


def test_equal_errors_have_no_correlation():
    measures = rung_measures(np.ones(5), np.arange(1.0, 6.0), top=3, kept=2)
    assert (measures["spearman"], measures["kendall"], measures["crossing_rate"]) == (None, None, None)


def test_a_survivor_of_asha_is_counted(rng):
    (entry,) = audit_rungs(trials(rng, 0.0, count=30), [10], kept=1 / 3)
    assert (entry.top, entry.survival, entry.recall) == (3, 1.0, 1.0)
    assert audit_rungs(trials(rng, 0.0, count=60), [10])[0].top == 6


@pytest.mark.parametrize(("noise", "verdict"), [(0.01, "reliable"), (5.0, "unreliable")])
def test_the_verdict_follows_the_noise(rng, noise, verdict):
    (entry,) = audit_rungs(trials(rng, noise), [10])
    low, high = entry.spearman_ci95
    assert entry.verdict == verdict
    assert low <= entry.spearman <= high
    assert entry.why_no_interval == ""


@pytest.mark.parametrize("count", [2, 3, 6, 11])
def test_few_trials_leave_the_verdict_undecided_and_have_no_interval(rng, count):
    (entry,) = audit_rungs(trials(rng, 0.25, count=count), [10])
    assert (entry.verdict, entry.trials, entry.spearman_ci95) == ("undecided", count, None)
    assert entry.why_no_interval == f"{count} trials, and at least 12 are needed"
    assert (entry.spearman is None) == (count < 4)


def test_equal_errors_are_undecided():
    (entry,) = audit_rungs([trial(number, {10: 1.0, 90: 0.1}) for number in range(20)], [10])
    assert (entry.verdict, entry.why_no_interval) == ("undecided", "all errors are equal")


def test_an_interval_is_wide_for_few_trials_even_where_the_order_is_the_same():
    ends = [spearman_interval(1.0, trials) for trials in (12, 32, 100)]
    assert [high for _, high in ends] == [1.0, 1.0, 1.0]
    assert 0.9 < ends[0][0] < ends[1][0] < ends[2][0] < 1
    low, high = spearman_interval(0.5, 32)
    assert spearman_interval(-0.5, 32) == pytest.approx([-high, -low])


def test_only_completed_trials_that_were_measured_take_part(rng):
    known = trials(rng, 0.1, count=14)
    others = [trial("a", {10: 1e-9}, outcome="diverged"), trial("b", {90: 1e-9}), trial("c", {}, outcome="failed")]
    assert audit_rungs([*known, *others], [10]) == audit_rungs(known, [10])
