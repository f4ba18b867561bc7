"""Ratios and intervals: what is exact, and what agrees with scipy; test_coverage.py says how often they hold."""

import numpy as np
import pytest
import scipy.stats

from cconv.errors import ConfigError, DataError, ShapeError
from cconv.evaluation.statistics import (
    SMALLEST_ERROR,
    crossed_interval,
    crossed_standard_error,
    mean_interval,
    paired_ratio,
    times_tie,
    why_no_interval,
)


@pytest.fixture
def rng():
    return np.random.default_rng(3)


def errors(rng, seeds=5, units=6, spread=0.3):
    return 1e-3 * np.exp(rng.normal(0, spread, (seeds, units)))


def test_swapping_the_models_turns_the_ratio_over(rng):
    ours, reference = errors(rng), errors(rng)
    there, back = paired_ratio(ours, reference), paired_ratio(reference, ours)
    assert back.ratio == pytest.approx(1 / there.ratio)
    assert back.log_standard_error == pytest.approx(there.log_standard_error)
    assert back.ci95 == pytest.approx((1 / there.ci95[1], 1 / there.ci95[0]))


def test_the_unit_of_the_error_scales_its_interval_and_leaves_the_ratio(rng):
    ours, reference = errors(rng), errors(rng)
    assert paired_ratio(1024 * ours, 1024 * reference).ci95 == pytest.approx(paired_ratio(ours, reference).ci95)
    low, high = crossed_interval(ours)
    assert crossed_interval(1024 * ours) == pytest.approx((1024 * low, 1024 * high))


def test_what_a_unit_does_to_both_drops_out(rng):
    ours, reference, hard = errors(rng), errors(rng), np.exp(rng.normal(0, 2, (1, 6)))
    alike = paired_ratio(ours * hard, reference * hard)
    assert alike.ci95 == pytest.approx(paired_ratio(ours, reference).ci95)
    assert alike.ratio == pytest.approx(scipy.stats.gmean((ours / reference).ravel()))


def test_one_axis_agrees_with_scipy(rng):
    values = rng.normal(size=20)
    theirs = scipy.stats.ttest_1samp(values, 0).confidence_interval(0.95)
    assert mean_interval(values[None]) == pytest.approx((theirs.low, theirs.high))
    assert crossed_standard_error(values[None]) == pytest.approx((scipy.stats.sem(values), 19))


def test_a_single_row_is_paired_with_every_seed(rng):
    ours, closed_form = errors(rng), errors(rng, seeds=1)
    assert paired_ratio(ours, closed_form) == paired_ratio(ours, np.repeat(closed_form, 5, axis=0))


@pytest.mark.parametrize("shape", [(1, 1), (1, 5), (4, 1), (4, 4)])
def test_equal_ratios_leave_no_interval(rng, shape):
    reference = errors(rng, *shape)
    compared = paired_ratio(2 * reference, reference)
    assert compared.ratio == pytest.approx(2)
    assert compared.log_standard_error == pytest.approx(0, abs=1e-12)
    assert compared.ci95 is None if why_no_interval(*shape) else compared.ci95 == pytest.approx((2, 2))


def test_an_interval_of_a_mean_is_positive_holds_it_and_shrinks_to_a_constant(rng):
    table = errors(rng, 5, 6)
    low, high = crossed_interval(table)
    assert 0 < low < table.mean() < high
    assert crossed_interval(table) == (low, high)  # seeded
    assert crossed_interval(np.full((4, 4), 0.5)) == pytest.approx((0.5, 0.5))
    assert high / low < np.divide(*crossed_interval(errors(rng, 5, 4))[::-1])


def test_many_units_give_the_interval_of_the_law_of_large_numbers(rng):
    table = errors(rng, 1, 2000)
    low, high = crossed_interval(table)
    width = 1.96 * scipy.stats.sem(table[0])
    assert (low, high) == pytest.approx((table.mean() - width, table.mean() + width), rel=0.01)
    assert high - low == pytest.approx(2 * width, rel=0.2)


def test_errors_below_what_float32_resolves_count_as_that(rng):
    assert paired_ratio(np.full((1, 4), 10 * SMALLEST_ERROR), np.zeros((1, 4))).ratio == pytest.approx(10)
    assert np.isfinite(crossed_interval(np.array([[0.0, 1e-30, 1e30, 1.0]]))).all()


def test_errors_that_cannot_be_paired_are_refused(rng):
    with pytest.raises(ShapeError, match="cannot be paired"):
        paired_ratio(errors(rng, seeds=5), errors(rng, seeds=4))
    with pytest.raises(ShapeError, match=r"\(seeds, units\)"):
        paired_ratio(np.ones(3), np.ones((1, 3)))
    with pytest.raises(DataError, match="finite"):
        crossed_interval(np.array([[1.0, np.nan, 1.0, 1.0]]))


def test_times_within_their_noise_tie():
    rng = np.random.default_rng(0)
    load = np.exp(rng.normal(0, 0.5, 20))  # other work on the machine, which slows both of a turn alike
    noise = np.exp(rng.normal(0, 0.05, (2, 20)))
    assert times_tie(load * noise[0], load * noise[1])
    assert times_tie(1.01 * load, load)  # too little to choose by
    assert not times_tie(1.2 * load * noise[0], load * noise[1])
    assert not times_tie(load * noise[1], 1.2 * load * noise[0])


def test_one_time_of_many_does_not_undo_a_tie():
    times = np.ones(20)
    spiked = times.copy()
    spiked[3] = 100.0
    assert times_tie(times, spiked)


def test_five_turns_tell_nothing_apart_and_six_do():
    assert times_tie([1.0] * 5, [2.0] * 5)
    assert not times_tie([1.0] * 6, [2.0] * 6)


def test_a_tie_is_declared_in_nineteen_of_twenty_equal_pairs():
    rng = np.random.default_rng(0)
    draws = np.exp(rng.normal(0, 0.5, (400, 2, 21)))
    ties = np.mean([times_tie(*pair) for pair in draws])
    assert 0.93 < ties <= 1


def test_turns_of_different_runs_are_refused():
    with pytest.raises(ConfigError, match="same turns"):
        times_tie([1.0] * 6, [1.0] * 7)
