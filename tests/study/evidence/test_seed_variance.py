"""Variance decomposition: spreads are what they say; evaluation/test_coverage.py says how often intervals hold."""

import numpy as np
import pytest

from cconv.study.evidence.seed_variance import compare_variances, variance_decomposition
from cconv.study.records.trials import TrialRecord


def trial(number, errors):
    log = [{"updates": updates, "valid_error": error} for updates, error in errors.items()]
    return TrialRecord(id=f"{number}", stage="random", parameters={}, config={}, log=log, outcome="stopped", reason="")


@pytest.fixture
def rng():
    return np.random.default_rng(0)


def test_each_rung_compares_what_reached_it():
    seeds = [trial(number, {10: 0.1 * 10**number, 30: 0.01}) for number in range(2)]
    configurations = [trial(0, {10: 1.0, 30: 0.1}), trial(1, {10: 100.0, 30: 0.001}), trial(2, {10: None})]
    first, second = variance_decomposition(seeds, configurations, [10, 30, 90])
    assert (first.updates, first.seeds, first.configurations) == (10, 2, 2)
    assert first.seed_spread == pytest.approx(np.sqrt(0.5))
    assert first.configuration_spread == pytest.approx(np.sqrt(2))
    assert first.seed_share == pytest.approx(0.25)
    assert (second.seed_share, first.seed_share_ci95, second.seed_share_ci95) == (0.0, None, None)


def test_no_seeds_no_entries():
    assert variance_decomposition([], [trial(0, {10: 1.0})], [10]) == []


def test_configurations_without_spread_have_no_share():
    entry = compare_variances(np.array([0.1, 0.2]), np.array([0.3, 0.3]))
    assert entry["seed_share"] is None
    assert entry["seed_share_ci95"] is None


def test_the_unit_of_the_logarithm_does_not_matter(rng):
    seeds, configurations = rng.normal(size=8), rng.normal(size=15)
    entry, scaled = compare_variances(seeds, configurations), compare_variances(2 * seeds, 2 * configurations)
    assert scaled["seed_share_ci95"] == pytest.approx(entry["seed_share_ci95"])
    assert entry["seed_share_ci95"][0] < entry["seed_share"] < entry["seed_share_ci95"][1]
    assert scaled["seed_spread"] == pytest.approx(2 * entry["seed_spread"])
