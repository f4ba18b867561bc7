"""Paired differences: what is exact, what agrees with scipy on one axis, and how often intervals hold the truth."""

import dataclasses
import json

import numpy as np
import pytest
import scipy.stats

from cconv.errors import DataError, ShapeError
from cconv.evaluation.statistics import (
    crossed_bca_interval,
    crossed_standard_error,
    expanded_confidence,
    paired_difference,
)


@pytest.fixture
def rng():
    return np.random.default_rng(3)


def errors(rng, seeds=5, units=6, spread=0.3):
    return 1e-3 * np.exp(rng.normal(0, spread, (seeds, units)))


def mean_of(values):
    return lambda rows, columns: values[rows, columns].mean((-2, -1))


def test_swapping_the_models_turns_the_sign(rng):
    ours, reference = errors(rng), errors(rng)
    there, back = paired_difference(ours, reference), paired_difference(reference, ours)
    assert back.difference == pytest.approx(-there.difference)
    assert back.standard_error == pytest.approx(there.standard_error)
    assert back.ci95 == pytest.approx((-there.ci95[1], -there.ci95[0]))
    assert back.ratio == pytest.approx(1 / there.ratio)
    assert back.ratio_ci95 == pytest.approx((1 / there.ratio_ci95[1], 1 / there.ratio_ci95[0]), rel=0.05)
    assert (back.p_over_seeds, back.p_over_units) == (there.p_over_seeds, there.p_over_units)


def test_the_unit_of_the_error_scales_the_difference_and_leaves_the_ratio(rng):
    ours, reference = errors(rng), errors(rng)
    small, large = paired_difference(ours, reference), paired_difference(1024 * ours, 1024 * reference)
    assert large.ci95 == pytest.approx([1024 * end for end in small.ci95])
    assert large.ratio_ci95 == pytest.approx(small.ratio_ci95)


def test_a_ratio_above_one_is_a_positive_difference(rng):
    for _ in range(10):
        compared = paired_difference(errors(rng), errors(rng), resamples=99)
        assert (compared.ratio > 1) == (compared.difference > 0)
        assert compared.ci95[0] < compared.difference < compared.ci95[1]


def test_one_axis_agrees_with_scipy(rng):
    values = rng.exponential(size=20)
    ours = crossed_bca_interval(mean_of(values[None]), (1, 20), resamples=9999)
    theirs = scipy.stats.bootstrap((values,), np.mean, method="BCa", n_resamples=9999, rng=1).confidence_interval
    assert ours == pytest.approx(tuple(theirs), abs=0.02)
    assert crossed_standard_error(values[None]) == pytest.approx((scipy.stats.sem(values), 19))


def test_p_values_are_those_of_all_sign_flips(rng):
    differences = rng.normal(0.5, 1, (5, 7))
    reference = np.full((1, 7), 10.0)
    compared = paired_difference(reference + differences, reference, resamples=99)
    for p_value, axis in ((compared.p_over_seeds, 1), (compared.p_over_units, 0)):
        means = differences.mean(axis=axis)
        signs = np.array(np.meshgrid(*[[-1, 1]] * len(means))).reshape(len(means), -1)
        flipped = np.abs((signs * means[:, None]).mean(axis=0))
        assert p_value == pytest.approx(np.mean(flipped >= abs(means.mean()) - 1e-12))


def test_a_single_row_is_paired_with_every_seed(rng):
    ours, closed_form = errors(rng), errors(rng, seeds=1)
    assert paired_difference(ours, closed_form) == paired_difference(ours, np.repeat(closed_form, 5, axis=0))
    alone = paired_difference(errors(rng, seeds=1), closed_form)
    assert alone.p_over_seeds is None
    assert alone.p_over_units is not None


@pytest.mark.parametrize("shape", [(1, 1), (1, 4), (3, 1), (3, 4)])
def test_equal_differences_leave_no_interval(rng, shape):
    reference = errors(rng, *shape)
    compared = paired_difference(reference + 1e-3, reference)
    assert compared.difference == pytest.approx(1e-3)
    assert compared.standard_error == pytest.approx(0, abs=1e-12)
    assert compared.ci95 == pytest.approx((1e-3, 1e-3))
    same = paired_difference(reference, reference)
    assert (same.difference, same.ci95, same.ratio_ci95) == (0.0, (0.0, 0.0), (1.0, 1.0))


def test_differences_that_cancel_in_every_row_and_column_still_have_an_interval():
    low, high = paired_difference(np.array([[3.0, 1.0], [1.0, 3.0]]), np.full((1, 2), 2.0)).ci95
    assert low < 0 < high


def test_a_reference_without_error_has_no_ratio(rng):
    compared = paired_difference(errors(rng), np.zeros((1, 6)))
    assert compared.ratio is None
    assert compared.ratio_ci95 is None
    assert json.loads(json.dumps(dataclasses.asdict(compared), allow_nan=False))["seeds"] == 5


def test_errors_that_cannot_be_paired_are_refused(rng):
    with pytest.raises(ShapeError, match="cannot be paired"):
        paired_difference(errors(rng, seeds=5), errors(rng, seeds=4))
    with pytest.raises(ShapeError, match=r"\(seeds, units\)"):
        paired_difference(np.ones(3), np.ones((1, 3)))
    with pytest.raises(DataError, match="finite"):
        paired_difference(np.array([[1.0, np.nan]]), np.ones((1, 2)))


def test_expanded_intervals_of_five_seeds_cover_nearly_as_often_as_they_say(rng):
    covered, plain, tables = 0, 0, 300
    for _ in range(tables):
        values = rng.normal(size=(5, 1)) + rng.normal(size=(1, 6)) + rng.normal(size=(5, 6))
        confidence = expanded_confidence(crossed_standard_error(values)[1])
        for level, name in ((confidence, "expanded"), (0.95, "plain")):
            low, high = crossed_bca_interval(mean_of(values), values.shape, resamples=1999, confidence=level)
            covered += name == "expanded" and low <= 0 <= high
            plain += name == "plain" and low <= 0 <= high
    assert 0.92 < covered / tables < 0.99
    assert plain < covered


def test_many_draws_need_no_expansion():
    assert expanded_confidence(1e6) == pytest.approx(0.95, abs=1e-4)
    assert expanded_confidence(4) > 0.99
