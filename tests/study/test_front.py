"""Hypervolume and attainment: exact cases, laws, and a brute-force oracle."""

import json

import numpy as np
import pytest

from cconv.errors import DataError, ShapeError
from cconv.study.front import attainment, bootstrap_hypervolume, hypervolume

REFERENCE = (1.0, 100.0)


@pytest.fixture
def rng():
    return np.random.default_rng(0)


@pytest.fixture
def models(rng):
    means = {"cheap": 0.1, "middle": 0.02, "beaten": 0.05, "best": 0.01}
    errors = {name: mean * np.exp(rng.normal(0, 0.3, (5, 8))) for name, mean in means.items()}
    errors["closed_form"] = errors["cheap"][:1] * 2
    return errors, {"closed_form": 0.1, "cheap": 1.0, "middle": 4.0, "beaten": 5.0, "best": 20.0}


def test_one_point_dominates_a_rectangle_of_decades():
    assert hypervolume([(0.01, 1.0)], REFERENCE) == pytest.approx(2 * 2)
    assert hypervolume([(0.01, 1.0), (0.1, 0.1)], REFERENCE) == pytest.approx(2 * 2 + 1 * 1)


def test_points_beyond_the_reference_and_no_points_dominate_nothing():
    assert hypervolume([(2.0, 1.0), (0.5, 200.0), (1.0, 1.0)], REFERENCE) == 0.0
    assert hypervolume([], REFERENCE) == 0.0


def test_a_beaten_point_adds_nothing_and_a_better_one_adds_something(rng):
    points = [tuple(point) for point in 10 ** rng.uniform((-3, -1), (0, 2), (10, 2))]
    area = hypervolume(points, REFERENCE)
    assert hypervolume([*points, (points[0][0] * 1.1, points[0][1] * 1.1)], REFERENCE) == pytest.approx(area)
    assert hypervolume([*points, (1e-4, 0.05)], REFERENCE) > area
    assert hypervolume(reversed(points), REFERENCE) == area


def test_the_area_agrees_with_points_thrown_at_random(rng):
    points = rng.uniform((-3, -1), (0, 2), (12, 2))
    thrown = rng.uniform((-3, -1), (0, 2), (200_000, 2))
    dominated = (points[:, None] <= thrown).all(axis=2).any(axis=0).mean() * 9
    assert hypervolume(10**points, REFERENCE) == pytest.approx(dominated, abs=0.03)


def test_the_interval_holds_the_hypervolume_and_closes_without_spread(models):
    errors, cost = models
    entry = bootstrap_hypervolume(errors, cost, REFERENCE)
    assert entry["ci95"][0] < entry["hypervolume"] < entry["ci95"][1]
    assert json.loads(json.dumps(entry, allow_nan=False))["reference"] == [1.0, 100.0]
    still = {name: np.full((3, 4), table.mean()) for name, table in errors.items()}
    entry = bootstrap_hypervolume(still, cost, REFERENCE)
    assert entry["ci95"] == pytest.approx([entry["hypervolume"]] * 2)


def test_the_band_falls_with_cost_and_holds_its_median(models):
    band = attainment(*models)
    assert band["cost"] == sorted(models[1].values())
    low, median, high = (np.array(band[name]) for name in ("low", "median", "high"))
    assert (low <= median).all()
    assert (median <= high).all()
    assert all((np.diff(edge) <= 0).all() for edge in (low, median, high))
    assert band["low"][0] == band["high"][0]  # a closed form has no seeds


def test_the_cheapest_model_attains_the_quantiles_of_its_own_seeds():
    errors = {"a": np.arange(1.0, 12.0)[:, None], "b": np.full((1, 1), 100.0)}
    band = attainment(errors, {"a": 1.0, "b": 2.0}, draws=20_000)
    assert (band["low"], band["median"], band["high"]) == ([2.0, 2.0], [6.0, 6.0], [10.0, 10.0])


def test_models_without_cost_or_with_other_units_are_refused(models):
    errors, cost = models
    with pytest.raises(DataError, match="missing: best"):
        attainment(errors, {name: value for name, value in cost.items() if name != "best"})
    with pytest.raises(DataError, match="every model"):
        bootstrap_hypervolume({}, {}, REFERENCE)
    with pytest.raises(ShapeError, match="same units"):
        bootstrap_hypervolume(errors | {"best": np.ones((2, 3))}, cost, REFERENCE)
