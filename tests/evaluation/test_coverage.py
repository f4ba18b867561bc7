"""Every interval that the product prints holds the true value as often as it says, at the sizes that studies have.

Errors are simulated as a study finds them: an effect of the seed, one of the unit and one of both on the logarithm,
with standard deviations of 0.1 to 0.5, 0.3 to 1 and 0.1 to 0.3. `INTERVALS` lists what is printed. A study has one seed
(closed forms) or five, and four units or more; below, no interval is given.
"""

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import pytest

from cconv.evaluation.statistics import FEWEST, crossed_interval, mean_interval, paired_ratio, why_no_interval
from cconv.study.evidence.effects import effects
from cconv.study.evidence.front import hypervolume, hypervolume_interval
from cconv.study.evidence.rung_audit import FEWEST_FOR_INTERVAL, rung_measures, spearman_interval
from cconv.study.evidence.seed_variance import FEWEST_VALUES, compare_variances

SPREADS = [(0.1, 0.3, 0.1), (0.3, 0.5, 0.3), (0.5, 1.0, 0.3)]  # of seed, unit and both
SHAPES = [(1, 4), (1, 5), (1, 12), (4, 4), (5, 4), (5, 5), (5, 12), (8, 6)]
COSTS = {"closed form": 0.1, "small": 1.0, "middle": 4.0, "beaten": 5.0, "large": 20.0}
TYPICAL = {"closed form": 0.3, "small": 0.1, "middle": 0.02, "beaten": 0.05, "large": 0.01}
CORNER = (1.3, 100.0)


class Simulated(NamedTuple):
    """An interval of simulated errors, and the true value that it should hold."""

    interval: tuple[float, float] | None
    truth: float


def errors(rng, shape, spreads, typical=1.0):
    """A table (seeds, units) of errors; a single seed is none that was drawn."""
    seeds, units = shape
    of_seed, of_unit, of_both = spreads if seeds > 1 else (0.0, spreads[1], 0.0)
    effects = (
        of_seed * rng.normal(size=(seeds, 1)),
        of_unit * rng.normal(size=(1, units)),
        of_both * rng.normal(size=(seeds, units)),
    )
    return typical * np.exp(sum(effects))


def error_on_the_test_split(rng, shape, spreads) -> Simulated:
    """The normalized MSE of a finalist: charts, tables, terminal, answer, card."""
    of_seed, of_unit, of_both = spreads if shape[0] > 1 else (0.0, spreads[1], 0.0)
    mean = math.exp((of_seed**2 + of_unit**2 + of_both**2) / 2)
    return Simulated(crossed_interval(errors(rng, shape, spreads)), mean)


def ratio_to_the_best(rng, shape, spreads) -> Simulated:
    """The error of a finalist by that of the best, on units that are as hard for both: reason, table of comparisons."""
    shared = errors(rng, (1, shape[1]), spreads)
    ours, best = (shared * errors(rng, shape, spreads, typical) for typical in (3.0, 2.0))
    return Simulated(paired_ratio(ours, best).ci95, 1.5)


def ratio_to_a_closed_form(rng, shape, spreads) -> Simulated:
    """The same, where the best has no seeds."""
    ours, best = errors(rng, shape, spreads, 3.0), errors(rng, (1, shape[1]), spreads, 2.0)
    return Simulated(paired_ratio(ours, best).ci95, 1.5)


def hypervolume_of_the_front(rng, shape, spreads) -> Simulated:
    """The area of the front: how sure are we."""
    tables = {
        name: errors(rng, (1, shape[1]) if name == "closed form" else shape, spreads, typical)
        for name, typical in TYPICAL.items()
    }
    truth = hypervolume(((TYPICAL[name], COSTS[name]) for name in TYPICAL), CORNER)
    return Simulated(hypervolume_interval(tables, COSTS, CORNER).ci95, truth)


INTERVALS: dict[str, Callable[..., Simulated]] = {
    "test error": error_on_the_test_split,
    "ratio to the best": ratio_to_the_best,
    "ratio to a closed form": ratio_to_a_closed_form,
    "hypervolume": hypervolume_of_the_front,
}


def coverage(simulate: Callable[[], Simulated], times: int) -> float:
    """Share of simulated intervals that hold the true value."""
    return float(np.mean([low <= truth <= high for (low, high), truth in (simulate() for _ in range(times))]))


def check(name: str, found: float, times: int) -> None:
    """Assert that a share of `times` simulations is one that 93 to 97 % would give."""
    chance = 3.3 * math.sqrt(0.95 * 0.05 / times)  # one in a thousand of such checks fails by chance; seeds are fixed
    assert 0.93 - chance <= found <= 0.97 + chance, f"{name} covers {found:.3f}"


@pytest.mark.parametrize("name", INTERVALS)
def test_an_interval_covers_as_it_says_over_all_sizes(name):
    """A few simulations of each size and spread, taken together."""
    rng, sizes = np.random.default_rng(0), [(shape, spreads) for shape in SHAPES for spreads in SPREADS]
    times = 240 // len(sizes)
    found = [coverage(lambda case=case: INTERVALS[name](rng, *case), times) for case in sizes]
    check(name, float(np.mean(found)), times * len(sizes))


@pytest.mark.slow
@pytest.mark.parametrize("spreads", SPREADS)
@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("name", INTERVALS)
def test_an_interval_covers_as_it_says_at_each_size(name, shape, spreads):
    rng = np.random.default_rng(1)
    check(name, coverage(lambda: INTERVALS[name](rng, shape, spreads), 1000), 1000)


def share_of_variances(rng, counts, draw) -> Simulated:
    """The share of the luck of initial weights; a few configurations that hardly learn make their errors skewed."""
    seeds, configurations = 0.5 * rng.normal(size=counts[0]), draw(rng, counts[1])
    return Simulated(compare_variances(seeds, configurations, resamples=499)["seed_share_ci95"], 0.25)


DISTRIBUTIONS = {
    "normal": lambda rng, count: rng.normal(size=count),
    "skewed": lambda rng, count: rng.exponential(size=count),
}


@pytest.mark.parametrize("distribution", DISTRIBUTIONS)
def test_the_share_of_the_seeds_is_covered(distribution):
    rng = np.random.default_rng(2)
    found = coverage(lambda: share_of_variances(rng, (8, 32), DISTRIBUTIONS[distribution]), 150)
    check("share of the seeds", found, 150)


@pytest.mark.slow
@pytest.mark.parametrize("counts", [(8, 16), (8, 32), (12, 32)])
@pytest.mark.parametrize("distribution", DISTRIBUTIONS)
def test_the_share_of_the_seeds_is_covered_at_each_size(distribution, counts):
    rng = np.random.default_rng(3)
    found = coverage(lambda: share_of_variances(rng, counts, DISTRIBUTIONS[distribution]), 1000)
    check("share of the seeds", found, 1000)


def of_range(rng, shape):
    """Columns of a range as `effects` takes them, and a straight effect of variance 1."""
    drawn = rng.uniform(-1, 1, shape)
    return np.stack([drawn, drawn**2], axis=-1), math.sqrt(3) * drawn


def of_choice(rng, shape, values=3):
    """Columns of a choice, and an effect of variance 1."""
    drawn, effect = rng.integers(values, size=shape), np.linspace(-1, 1, values)
    return np.equal.outer(drawn, np.arange(values)).astype(float), (effect / effect.std())[drawn]


def of_others(rng, shape):
    """What other hyperparameters and luck do to the error, with variance 1: two ranges, a switch and noise."""
    ranges = sum(weight * math.sqrt(3) * rng.uniform(-1, 1, shape) for weight in (0.7, 0.4))
    return ranges + 0.5 * rng.choice([-1, 1], shape) + math.sqrt(0.1) * rng.normal(size=shape)


HYPERPARAMETERS = {"range": of_range, "choice": of_choice, "switch": lambda rng, shape: of_choice(rng, shape, 2)}
RESIDUALS = {"normal": lambda rng, shape: rng.normal(size=shape), "of others": of_others}
STRENGTHS = (0.05, 0.2, 0.5)  # shares of the variance


def coverage_of_a_share(rng, name, residuals, share, shape) -> float:
    """Share of (samples, trials) whose interval holds the share of the variance."""
    columns, effect = HYPERPARAMETERS[name](rng, shape)
    targets = math.sqrt(share) * effect + math.sqrt(1 - share) * RESIDUALS[residuals](rng, shape)
    low, high = effects(columns, targets).interval95
    return float(np.mean((low <= share) & (share <= high)))


@pytest.mark.parametrize("trials", [24, 36, 100])
@pytest.mark.parametrize("name", HYPERPARAMETERS)
def test_the_share_of_a_hyperparameter_is_covered(name, trials):
    rng, times = np.random.default_rng(5), 60
    cases = [(residuals, share) for residuals in RESIDUALS for share in STRENGTHS]
    found = [coverage_of_a_share(rng, name, *case, (times, trials)) for case in cases]
    check(f"share of a {name}", float(np.mean(found)), times * len(cases))


@pytest.mark.slow
@pytest.mark.parametrize("share", STRENGTHS)
@pytest.mark.parametrize("residuals", RESIDUALS)
@pytest.mark.parametrize("trials", [14, 24, 36, 100])
@pytest.mark.parametrize("name", HYPERPARAMETERS)
def test_the_share_of_a_hyperparameter_is_covered_at_each_strength(name, trials, residuals, share):
    rng = np.random.default_rng(6)
    check(f"share of a {name}", coverage_of_a_share(rng, name, residuals, share, (2000, trials)), 2000)


def rank_correlation(rng, trials, correlation) -> Simulated:
    """Spearman's of the errors at a rung and at the full budget, whose logarithms are normal."""
    noise = rng.normal(size=(2, trials))
    at_full = correlation * noise[0] + math.sqrt(1 - correlation**2) * noise[1]
    found = rung_measures(noise[0], at_full, top=3, kept=4)["spearman"]
    return Simulated(spearman_interval(found, trials), 6 / math.pi * math.asin(correlation / 2))


@pytest.mark.parametrize("trials", [12, 16, 32])
def test_the_rank_correlation_of_a_rung_is_covered(trials):
    rng, times = np.random.default_rng(7), 60
    found = [coverage(lambda r=r: rank_correlation(rng, trials, r), times) for r in (0.0, 0.6, 0.9)]
    check("rank correlation", float(np.mean(found)), 3 * times)


@pytest.mark.slow
@pytest.mark.parametrize("correlation", [0.0, 0.3, 0.6, 0.8, 0.9])
@pytest.mark.parametrize("trials", [12, 16, 32])
def test_the_rank_correlation_of_a_rung_is_covered_at_each_size(trials, correlation):
    rng = np.random.default_rng(8)
    check("rank correlation", coverage(lambda: rank_correlation(rng, trials, correlation), 2000), 2000)


@pytest.mark.parametrize("shape", [(1, 1), (1, 2), (1, 3), (2, 8), (3, 8), (5, 2), (5, 3)])
def test_none_is_printed_where_none_would_cover(shape):
    """Bootstrap intervals of such tables covered 48 to 87 %; the reason is given in their place."""
    rng = np.random.default_rng(4)
    for simulate in INTERVALS.values():
        assert simulate(rng, shape, SPREADS[0]).interval is None
    assert f"at least {FEWEST} are needed" in why_no_interval(*shape)
    assert mean_interval(np.zeros(shape)) is None
    few = rng.normal(size=FEWEST_VALUES - 1), rng.normal(size=20)
    assert compare_variances(*few)["seed_share_ci95"] is None
    assert spearman_interval(0.9, FEWEST_FOR_INTERVAL - 1) is None
