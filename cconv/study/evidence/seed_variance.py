"""The seed variance: how much of the spread among configurations the initial weights cause (thesis, section 4.1)."""

import math
from collections.abc import Sequence

import numpy as np
import scipy.stats

from cconv.study.records.found import SeedVariance
from cconv.study.records.trials import TrialRecord

FEWEST_VALUES = 8  # with fewer, intervals of a ratio of variances cover 98 % and more, or far less if values are skewed


def variance_decomposition(
    seed_records: Sequence[TrialRecord],
    configuration_records: Sequence[TrialRecord],
    rungs: Sequence[int],
    *,
    resamples: int = 4999,
    seed: int = 0,
) -> list[SeedVariance]:
    """Compare the variance over seeds of one configuration with that over configurations with one seed, at each rung.

    Args:
        seed_records: Trials of one configuration that differ in the seed of the initial weights.
        configuration_records: Trials with one seed that differ in the configuration. Those that were stopped before a
            rung do not count there, so that from the second rung on the variance is that of the remaining ones.
        rungs: Updates at which both were measured.
        resamples: Bootstrap resamples.
        seed: Seed of the resampling.

    Returns:
        One entry a rung; the variance over configurations includes that over seeds. The interval of their ratio is None
        with fewer than `FEWEST_VALUES` of either. A rung that fewer than two of either reached has no entry.
    """
    entries = []
    for updates in rungs:
        over_seeds = _logarithms(seed_records, updates)
        over_configurations = _logarithms(configuration_records, updates)
        if min(len(over_seeds), len(over_configurations)) > 1:
            compared = compare_variances(over_seeds, over_configurations, resamples=resamples, seed=seed)
            counts = {"seeds": len(over_seeds), "configurations": len(over_configurations)}
            entries.append(SeedVariance(updates=updates, **counts, **compared))
    return entries


def compare_variances(
    over_seeds: np.ndarray, over_configurations: np.ndarray, *, resamples: int = 4999, seed: int = 0
) -> dict:
    """Compute the standard deviations of two samples of log10 errors, and the ratio of the variances with an interval.

    A few configurations that hardly learn make the logarithms skewed; intervals by the F-distribution then cover the
    true ratio in 87 to 90 % of simulated cases. This one is the logarithm of the ratio plus and minus its bootstrap
    standard error times the quantile of Student's t, with the degrees of freedom of the smaller sample.
    """
    of_seeds, of_configurations = np.var(over_seeds, ddof=1), np.var(over_configurations, ddof=1)
    share = float(of_seeds / of_configurations) if of_configurations > 0 else None
    return {
        "seed_spread": math.sqrt(of_seeds),
        "configuration_spread": math.sqrt(of_configurations),
        "seed_share": share,
        "seed_share_ci95": _bootstrap_interval(share, over_seeds, over_configurations, resamples, seed),
    }


def _bootstrap_interval(
    share: float | None, over_seeds: np.ndarray, over_configurations: np.ndarray, resamples: int, seed: int
) -> list[float] | None:
    fewest = min(len(over_seeds), len(over_configurations))
    if not share or fewest < FEWEST_VALUES:
        return None
    rng = np.random.default_rng(seed)
    variances = np.array(
        [
            rng.choice(values, (resamples, len(values))).var(axis=1, ddof=1)
            for values in (over_seeds, over_configurations)
        ]
    )
    logarithms = np.log(variances[:, (variances > 0).all(axis=0)])
    error = (logarithms[0] - logarithms[1]).std(ddof=1)
    factor = math.exp(scipy.stats.t.ppf(0.975, fewest - 1) * error)
    return [share / factor, share * factor]


def _logarithms(records: Sequence[TrialRecord], updates: int) -> np.ndarray:
    errors = [record.error_at(updates) for record in records]
    return np.log10([error for error in errors if error is not None and error > 0])
