"""Hypervolume and attainment: exact cases, laws, and a brute-force oracle."""

import numpy as np
import pytest

from cconv.errors import DataError, ShapeError
from cconv.study.evidence.front import Timing, attainment, hypervolume, hypervolume_interval, pareto_front, timed_front

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


def test_front_holds_what_nothing_beats_in_both():
    points = {"cheap": (3.0, 1.0), "middle": (2.0, 2.0), "beaten": (2.5, 3.0), "best": (1.0, 4.0)}
    assert pareto_front(points) == ["cheap", "middle", "best"]


def test_front_of_equal_points_is_one_of_them():
    assert pareto_front({"a": (1.0, 1.0), "b": (1.0, 1.0)}) == ["a"]
    assert pareto_front({}) == []


def exact(ms):
    return Timing((ms,) * 20)


def noisy(rng, ms, noise):
    return Timing(tuple(ms + noise * rng.normal(size=21)))


def test_the_front_of_exact_times_is_the_pareto_front(rng):
    for _ in range(50):
        errors, ms = (dict(zip("abcdefgh", 1.1 ** rng.permutation(8), strict=True)) for _ in range(2))
        points = {name: (errors[name], ms[name]) for name in errors}
        assert timed_front(errors, {name: exact(time) for name, time in ms.items()}) == pareto_front(points)


def test_a_model_that_only_the_noise_of_the_timing_makes_faster_is_not_on_the_front(rng):
    errors = {"8 terms": 1.7e-4, "16 terms": 4e-5, "32 terms": 3.3e-7, "small": 1e-2}
    medians = dict(zip(errors, (2.46, 2.45, 2.52, 1), strict=True))
    times = {name: noisy(rng, ms, 0.05) for name, ms in medians.items()}
    assert timed_front(errors, times) == ["small", "32 terms"]
    assert pareto_front({name: (errors[name], medians[name]) for name in errors}) == ["small", "16 terms", "32 terms"]


def test_errors_fall_along_the_front(rng):
    for _ in range(50):
        errors, ms = (dict(zip("abcdefgh", rng.uniform(1, 2, 8), strict=True)) for _ in range(2))
        times = {name: noisy(rng, time, rng.uniform(0, 0.3)) for name, time in ms.items()}
        ms = {name: time.ms for name, time in times.items()}
        front = timed_front(errors, times)
        assert [ms[name] for name in front] == sorted(ms[name] for name in front)
        assert [errors[name] for name in front] == sorted((errors[name] for name in front), reverse=True)
        assert front[-1] == min(errors, key=errors.get)


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
    entry = hypervolume_interval(errors, cost, REFERENCE)
    assert entry.ci95[0] < entry.value < entry.ci95[1]
    assert entry.reference == (100.0, 1.0)
    still = {name: np.full((5, 4), table.mean()) for name, table in errors.items()}
    entry = hypervolume_interval(still, cost, REFERENCE)
    assert entry.ci95 == pytest.approx([entry.value] * 2)
    assert entry.value == pytest.approx(hypervolume([(still[n].mean(), cost[n]) for n in still], REFERENCE))


def test_the_hypervolume_is_that_of_geometric_means_and_has_no_interval_for_few_units(models):
    errors, cost = models
    typical = [(np.exp(np.log(table).mean()), cost[name]) for name, table in errors.items()]
    few = hypervolume_interval({name: table[:, :3] for name, table in errors.items()}, cost, REFERENCE)
    assert hypervolume_interval(errors, cost, REFERENCE).value == pytest.approx(hypervolume(typical, REFERENCE))
    assert few.ci95 is None
    assert "3 units" in few.why_no_interval


def test_a_front_beyond_the_reference_dominates_nothing(models):
    errors, cost = models
    entry = hypervolume_interval({name: 100 * table for name, table in errors.items()}, cost, (0.1, 100.0))
    assert (entry.value, entry.ci95) == (0.0, (0.0, 0.0))


def test_the_band_falls_with_cost_and_holds_its_median(models):
    band = attainment(*models)
    assert [step.ms_per_frame for step in band] == sorted(models[1].values())
    low, median, high = np.array([(step.low, step.median, step.high) for step in band]).T
    assert (low <= median).all()
    assert (median <= high).all()
    assert all((np.diff(edge) <= 0).all() for edge in (low, median, high))
    assert band[0].low == band[0].high  # a closed form has no seeds


def test_the_cheapest_model_attains_the_quantiles_of_its_own_seeds():
    errors = {"a": np.arange(1.0, 12.0)[:, None], "b": np.full((1, 1), 100.0)}
    band = attainment(errors, {"a": 1.0, "b": 2.0}, draws=20_000)
    assert [(step.low, step.median, step.high) for step in band] == [(2.0, 6.0, 10.0)] * 2


def test_models_without_cost_or_with_other_units_are_refused(models):
    errors, cost = models
    with pytest.raises(DataError, match="missing: best"):
        attainment(errors, {name: value for name, value in cost.items() if name != "best"})
    with pytest.raises(DataError, match="every model"):
        hypervolume_interval({}, {}, REFERENCE)
    with pytest.raises(ShapeError, match="same units"):
        hypervolume_interval(errors | {"best": np.ones((2, 3))}, cost, REFERENCE)
