"""Effects of single hyperparameters: what is exact, how often nothing is found, and how often something is."""

import numpy as np
import pytest
import scipy.stats

from cconv.study.evidence.effects import FAMILY_LEVEL, POWER, adjusted_p_values, detectable_share, effects


def levels(rng, shape, count):
    """Columns of a choice that is drawn evenly, and an effect of its values with variance 1."""
    drawn, values = rng.integers(count, size=shape), np.linspace(-1, 1, count)
    return np.equal.outer(drawn, np.arange(count)).astype(float), (values / values.std())[drawn]


def curve(rng, shape):
    """Columns of a range that is drawn evenly, and a straight effect with variance 1."""
    drawn = rng.uniform(-1, 1, shape)
    return np.stack([drawn, drawn**2], axis=-1), np.sqrt(3) * drawn


AXES = {
    "range": curve,
    "two": lambda rng, shape: levels(rng, shape, 2),
    "five": lambda rng, shape: levels(rng, shape, 5),
}
DEGREES = {"range": 2, "two": 1, "five": 4}


@pytest.fixture
def rng():
    return np.random.default_rng(0)


def test_the_test_of_a_choice_is_the_analysis_of_variance(rng):
    columns, _ = levels(rng, 40, 3)
    targets = rng.normal(size=40)
    found, expected = effects(columns, targets), scipy.stats.f_oneway(*(targets[column > 0] for column in columns.T))
    assert found.statistic == pytest.approx(expected.statistic)
    assert found.p_value == pytest.approx(expected.pvalue)
    assert (found.degrees, found.spare) == (2, 37)


def test_samples_are_fitted_each_by_itself_and_the_scale_of_targets_does_not_matter(rng):
    columns, _ = curve(rng, (5, 30))
    targets = rng.normal(size=(5, 30))
    together, one = effects(columns, targets), effects(columns[3], 7 - 2 * targets[3])
    assert together.statistic[3] == pytest.approx(one.statistic)
    assert together.widening[3] == pytest.approx(one.widening)


@pytest.mark.parametrize("name", AXES)
def test_the_interval_holds_the_estimate_and_grows_with_it(name, rng):
    columns, effect = AXES[name](rng, 30)
    noise, previous = rng.normal(size=30), -1.0
    for weight in (0.0, 0.5, 1.0, 2.0, 1e6):
        found = effects(columns, weight * effect + noise)
        low, high = found.interval95
        assert 0 <= low <= found.share <= high <= 1
        assert found.share > previous or found.share == 0
        previous = found.share
    assert low > 0.99


def test_what_does_not_vary_is_not_testable(rng):
    assert not effects(np.ones((20, 1)), rng.normal(size=20)).is_testable
    assert not effects(np.eye(20), rng.normal(size=20)).is_testable


@pytest.mark.parametrize("name", AXES)
def test_more_trials_detect_less_and_more_tests_detect_later(name):
    shares = [detectable_share(DEGREES[name], trials, 12) for trials in (12, 24, 36, 100, 200)]
    assert shares == sorted(shares, reverse=True)
    assert shares[0] < 1
    assert detectable_share(DEGREES[name], 24, 4) < detectable_share(DEGREES[name], 24, 12)


def test_detectable_shares_are_those_that_were_measured():
    """Of ranges in a space of twelve hyperparameters, by an earlier simulation."""
    shares = [detectable_share(2, trials, 12) for trials in (24, 36, 100, 200)]
    assert shares == pytest.approx([0.49, 0.36, 0.15, 0.08], abs=0.01)


@pytest.mark.parametrize("trials", [14, 24, 36, 100])
@pytest.mark.parametrize("name", AXES)
def test_a_detectable_share_is_found_four_times_in_five(name, trials, rng):
    tests, shape = 12, (4000, trials)
    share = detectable_share(DEGREES[name], trials, tests)
    columns, effect = AXES[name](rng, shape)
    targets = np.sqrt(share) * effect + np.sqrt(1 - share) * rng.normal(size=shape)
    level = 1 - (1 - FAMILY_LEVEL) ** (1 / tests)
    assert np.mean(effects(columns, targets).p_value <= level) == pytest.approx(POWER, abs=0.03)


def family(rng, trials):
    return [AXES[name](rng, trials) for name in [*AXES] * 4]


def found_any(rng, trials, clipped, permutations):
    """Whether anything is found in targets of noise, of which a share is clipped."""
    targets = rng.normal(size=trials)
    targets = np.minimum(targets, np.quantile(targets, 1 - clipped))
    columns = [columns for columns, _ in family(rng, trials)]
    seed = int(rng.integers(2**31))
    return adjusted_p_values(columns, targets, seed=seed, permutations=permutations).min() <= FAMILY_LEVEL


@pytest.mark.parametrize("clipped", [0.0, 0.5])
def test_where_nothing_decides_one_study_in_twenty_finds_something(clipped, rng):
    alarms = np.mean([found_any(rng, 24, clipped, 99) for _ in range(300)])
    assert alarms <= FAMILY_LEVEL + 3.3 * np.sqrt(0.05 * 0.95 / 300)


@pytest.mark.slow
@pytest.mark.parametrize("clipped", [0.0, 0.25, 0.5])
@pytest.mark.parametrize("trials", [20, 36, 100])
def test_false_alarms_are_as_rare_with_all_sizes_and_ceilings(trials, clipped, rng):
    alarms = np.mean([found_any(rng, trials, clipped, 199) for _ in range(1500)])
    assert alarms <= FAMILY_LEVEL + 3.3 * np.sqrt(0.05 * 0.95 / 1500)


def test_a_detectable_share_is_found_among_twelve_hyperparameters(rng):
    """By the p-values that a study reports, adjusted by permutation."""
    share, found = detectable_share(2, 24, 12), []
    for _ in range(250):
        drawn = family(rng, 24)
        targets = np.sqrt(share) * drawn[0][1] + np.sqrt(1 - share) * rng.normal(size=24)
        p_values = adjusted_p_values([columns for columns, _ in drawn], targets, seed=0, permutations=99)
        found.append(p_values[0] <= FAMILY_LEVEL)
    assert np.mean(found) == pytest.approx(POWER, abs=3.3 * np.sqrt(0.8 * 0.2 / 250))
