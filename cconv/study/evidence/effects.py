r"""The share of the variance of a target that one hyperparameter alone explains, with an interval and a test.

Trials draw hyperparameters at random, so that they vary more or less in a sample than in the space. Given the draws, F
follows the noncentral distribution with :math:`\lambda = g\,s / (1 - s)`, where s is the share and g the sum of squares
of the effect in the sample, divided by its variance in the space. Approximately, g follows a Gamma distribution of mean
n - 1 and variance (n - 1)(kurtosis - 1). Sources: Steiger, "Beyond the F test",
Psychological Methods 9 (2004), for a fixed g; Gatsonis and Sampson, "Multiple correlation: exact power and sample size
calculations", Psychological Bulletin 106 (1989), for normal draws, whose kurtosis is 3.
tests/evaluation/test_coverage.py simulates how often the interval holds the true share.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import scipy.special
from numpy.typing import ArrayLike, NDArray

FAMILY_LEVEL = 0.05  # familywise: probability of finding any hyperparameter where none has an effect
POWER = 0.8  # probability of finding a hyperparameter of the detectable share
_EVEN_KURTOSIS = 1.8  # of an effect that is linear in a uniformly drawn value
_ENDS = (0.975, 0.025)  # probability of a smaller F at the lower and upper end of a 95 % interval
_LARGEST_SHARE = 1 - 1e-6
_SMALL_SHARE = 0.02  # below it the estimate of the share is quadratic, and its influence function is no guide
_DRAWS = (np.arange(8) + 0.5) / 8  # levels of the quantiles that represent the distribution of g
_TINY = 1e-100


@dataclass(frozen=True)
class Effects:
    """The fitted effect of one hyperparameter in each of several samples; arrays have the shape of the samples.

    Attributes:
        degrees: Degrees of freedom of the effect; 0 where the sample does not vary the hyperparameter.
        spare: Degrees of freedom of the residuals.
        statistic: F.
        kurtosis: Kurtosis of the fitted effect over the trials.
        widening: Standard error of the share by its influence function ÷ that for normal residuals; at least 1, and
            larger for residuals with long tails or a ceiling.
    """

    degrees: NDArray[np.int64]
    spare: NDArray[np.int64]
    statistic: NDArray[np.float64]
    kurtosis: NDArray[np.float64]
    widening: NDArray[np.float64]

    @property
    def is_testable(self) -> NDArray[np.bool_]:
        """True if the effect and the residuals have degrees of freedom, so that a test is possible."""
        return (self.degrees > 0) & (self.spare > 0)

    @property
    def p_value(self) -> NDArray[np.float64]:
        """Probability of an F at least as large if the hyperparameter has no effect."""
        return _p_value(self)

    @property
    def share(self) -> NDArray[np.float64]:
        """Estimated share of the variance: epsilon squared, which corrects for the degrees of freedom."""
        return _adjusted(self.statistic, self.degrees, self.spare)

    @property
    def interval95(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Ends of the 95 % interval of the true share; if that is 0, 97.5 % of such intervals include it."""
        estimate = _stretched(self.share)
        ends = (_stretched(_last_where(self._is_below(end), self.share)) for end in _ENDS)
        low, high = (estimate + self.widening * (end - estimate) for end in ends)
        return _squeezed(np.minimum(low, estimate)), _squeezed(np.maximum(high, estimate))

    def _is_below(self, chance: float) -> Callable[[NDArray], NDArray]:
        facts = (self.degrees, self.spare, self.kurtosis)
        return lambda share: _chance_below(self.statistic, share, *facts) > chance


def effects(columns: NDArray[np.float64], targets: NDArray[np.float64]) -> Effects:
    """Fit columns and a constant to the targets of each sample by least squares.

    Args:
        columns: Terms of the effect, (..., M, K) for M trials.
        targets: (..., M), not all equal.
    """
    fit = _fit(columns, targets)
    kurtosis = np.mean(fit.fitted**4, axis=-1) / np.maximum(np.mean(fit.fitted**2, axis=-1), _TINY) ** 2
    share = _adjusted(fit.statistic, fit.degrees, fit.spare)
    normal = share * (1 - share) ** 2 * (2 * (2 - share) + (kurtosis - 1) * share)
    widening = np.clip(_robust_variance(fit, share) / np.maximum(normal, _TINY), 1, 9)
    widening = np.sqrt(np.where(share > _SMALL_SHARE, widening, 1.0))
    return Effects(fit.degrees, fit.spare, fit.statistic, kurtosis, widening)


class _Fit(NamedTuple):
    centred: NDArray[np.float64]
    fitted: NDArray[np.float64]
    degrees: NDArray[np.int64]
    spare: NDArray[np.int64]
    explained: NDArray[np.float64]
    statistic: NDArray[np.float64]


def _fit(columns: NDArray[np.float64], targets: NDArray[np.float64]) -> _Fit:
    centred = targets - targets.mean(axis=-1, keepdims=True)
    left, sizes, _ = np.linalg.svd(columns - columns.mean(axis=-2, keepdims=True), full_matrices=False)
    used = sizes > 1e-9 * np.maximum(np.linalg.norm(columns, axis=(-2, -1)), _TINY)[..., None]
    fitted = ((left * used[..., None, :]) @ (np.swapaxes(left, -1, -2) @ centred[..., None]))[..., 0]
    degrees = used.sum(axis=-1)
    spare = centred.shape[-1] - 1 - degrees
    explained = np.clip(np.sum(fitted**2, axis=-1) / np.sum(centred**2, axis=-1), 0, _LARGEST_SHARE)
    statistic = explained * spare / ((1 - explained) * np.maximum(degrees, 1))
    return _Fit(centred, fitted, degrees, spare, explained, statistic)


def _robust_variance(fit: _Fit, share: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the variance over trials of the influence of each on the share, corrected for overfitting."""
    count = fit.centred.shape[-1]
    residuals = (fit.centred - fit.fitted) * np.sqrt((count - 1) / np.maximum(fit.spare, 1))[..., None]
    true = residuals + fit.fitted * np.sqrt(share / np.maximum(fit.explained, _TINY))[..., None]
    influence = (1 - share)[..., None] * true**2 - residuals**2
    return influence.var(axis=-1, ddof=1) / fit.centred.var(axis=-1, ddof=1) ** 2


def adjusted_p_values(
    columns: Sequence[NDArray[np.float64]], targets: NDArray[np.float64], *, seed: int, permutations: int = 999
) -> NDArray[np.float64]:
    """Compute p-values of several hyperparameters, adjusted for their number.

    Each is the probability that any hyperparameter has a p-value as small if none has an effect. It comes from
    permutations of the targets over the trials, and so holds for targets of any distribution, with ties too.
    Source: Westfall and Young, "Resampling-Based Multiple Testing" (1993), single-step minP.

    Args:
        columns: Terms of the effect of each hyperparameter, (M, K), which vary over the M trials.
        targets: (M,), not all equal.
        seed: Seed of the permutations.
        permutations: Number of permutations.
    """
    shuffled = np.random.default_rng(seed).permuted(np.tile(targets, (permutations, 1)), axis=1)
    smallest = np.min([_p_value(_fit(each, shuffled)) for each in columns], axis=0)
    found = np.array([_p_value(_fit(each, targets)) for each in columns])
    return (1 + np.sum(smallest[:, None] <= found * (1 + 1e-9), axis=0)) / (1 + permutations)


def detectable_share(degrees: int, trials: int, tests: int) -> float:
    """Return the smallest share of the variance that is found with a probability of `POWER`.

    The level of each test is that of several independent tests with the familywise level `FAMILY_LEVEL` (Šidák, 1967).

    Args:
        degrees: Degrees of freedom of the effect.
        trials: Number of trials, more than `degrees` + 1.
        tests: Number of tests, one a hyperparameter.
    """
    spare = trials - 1 - degrees
    critical = scipy.special.fdtri(degrees, spare, (1 - FAMILY_LEVEL) ** (1 / tests))
    missed = 1 - POWER
    return float(
        _last_where(lambda share: _chance_below(critical, share, degrees, spare, _EVEN_KURTOSIS) > missed, 0.0)
    )


def _p_value(found: "Effects | _Fit") -> NDArray[np.float64]:
    return scipy.special.fdtrc(found.degrees, found.spare, found.statistic)


def _adjusted(statistic: NDArray, degrees: NDArray, spare: NDArray) -> NDArray[np.float64]:
    return np.maximum(1 - (degrees + spare) / np.maximum(spare + degrees * statistic, _TINY), 0)


def _stretched(share: NDArray) -> NDArray[np.float64]:
    return np.arctanh(np.sqrt(np.minimum(share, _LARGEST_SHARE)))


def _squeezed(stretched: NDArray) -> NDArray[np.float64]:
    return np.tanh(np.maximum(stretched, 0)) ** 2


def _chance_below(
    statistic: ArrayLike, share: ArrayLike, degrees: ArrayLike, spare: ArrayLike, kurtosis: ArrayLike
) -> NDArray[np.float64]:
    """Return the probability of a smaller F given the true share, averaged over the distribution of g."""
    spread = np.maximum(np.asarray(kurtosis, dtype=np.float64) - 1, 1e-3)[..., None]
    trials = (np.asarray(degrees) + np.asarray(spare) + 1)[..., None]
    scatter = spread * scipy.special.gammaincinv((trials - 1) / spread, _DRAWS)
    odds = (np.asarray(share) / (1 - np.asarray(share)))[..., None]
    freedom = [np.asarray(each, dtype=np.float64)[..., None] for each in (degrees, spare)]
    return scipy.special.ncfdtr(*freedom, odds * scatter, np.asarray(statistic)[..., None]).mean(axis=-1)


def _last_where(holds: Callable[[NDArray], NDArray], like: ArrayLike, steps: int = 24) -> NDArray[np.float64]:
    """Find by bisection the largest share at which a condition holds that holds for all smaller ones; 0 if for none."""
    low, high = np.zeros(np.shape(like)), np.full(np.shape(like), _LARGEST_SHARE)
    for _ in range(steps):
        middle = (low + high) / 2
        found = holds(middle)
        low, high = np.where(found, middle, low), np.where(found, high, middle)
    return low
