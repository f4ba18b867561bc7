r"""How much of the differences between trials one hyperparameter decides: its share with an interval, and tests.

The share is that of the variance of the target that the hyperparameter alone explains. Trials draw hyperparameters at
random, so that a sample varies them more or less than the space does: given the draws, F is noncentral with
:math:`\lambda = g\,s / (1 - s)`, where s is the share and g the scatter of the drawn effect by its variance, about
Gamma-distributed with mean n - 1 and variance (n - 1)(kurtosis - 1). Sources: Steiger, "Beyond the F test",
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

FAMILY_LEVEL = 0.05  # chance that any hyperparameter of a space is found where none decides anything
POWER = 0.8  # chance to find a hyperparameter of the detectable share
_EVEN_KURTOSIS = 1.8  # of an effect that is a straight line over an evenly drawn range
_ENDS = (0.975, 0.025)  # chance of a smaller F at the lower and upper end of a 95 % interval
_LARGEST_SHARE = 1 - 1e-6
_SMALL_SHARE = 0.02  # below, the influence function says nothing of the share, which is quadratic there
_DRAWS = (np.arange(8) + 0.5) / 8  # quantiles of the scatter that stand for all
_TINY = 1e-100


@dataclass(frozen=True)
class Effects:
    """What a fit says of the effect of one hyperparameter in each of some samples; arrays of the shape of the samples.

    Attributes:
        degrees: Degrees of freedom of the effect; 0 where the sample does not vary the hyperparameter.
        spare: Degrees of freedom that are left.
        statistic: F.
        kurtosis: Kurtosis of the fitted effect over the trials.
        widening: Standard error of the share as its influence function gives it, by that with normal residuals; at
            least 1, and more for residuals with tails or a ceiling.
    """

    degrees: NDArray[np.int64]
    spare: NDArray[np.int64]
    statistic: NDArray[np.float64]
    kurtosis: NDArray[np.float64]
    widening: NDArray[np.float64]

    @property
    def is_testable(self) -> NDArray[np.bool_]:
        """Whether there is an effect to test and something left to test it against."""
        return (self.degrees > 0) & (self.spare > 0)

    @property
    def p_value(self) -> NDArray[np.float64]:
        """Chance of an F as large where the hyperparameter decides nothing."""
        return _p_value(self)

    @property
    def share(self) -> NDArray[np.float64]:
        """Estimated share of the variance: epsilon squared, which chance alone does not raise above 0 on average."""
        return _adjusted(self.statistic, self.degrees, self.spare)

    @property
    def interval95(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Ends of the 95 % interval of the true share; where that is 0, 97.5 % of such intervals hold it."""
        estimate = _stretched(self.share)
        ends = (_stretched(_last_where(self._is_below(end), self.share)) for end in _ENDS)
        low, high = (estimate + self.widening * (end - estimate) for end in ends)
        return _squeezed(np.minimum(low, estimate)), _squeezed(np.maximum(high, estimate))

    def _is_below(self, chance: float) -> Callable[[NDArray], NDArray]:
        facts = (self.degrees, self.spare, self.kurtosis)
        return lambda share: _chance_below(self.statistic, share, *facts) > chance


def effects(columns: NDArray[np.float64], targets: NDArray[np.float64]) -> Effects:
    """Fit columns and a constant to targets by least squares, each sample by itself.

    Args:
        columns: What the effect is a sum of, (..., M, K) for M trials.
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
    """Variance over trials of the influence of each on the share, its residual and effect freed of overfitting."""
    count = fit.centred.shape[-1]
    residuals = (fit.centred - fit.fitted) * np.sqrt((count - 1) / np.maximum(fit.spare, 1))[..., None]
    true = residuals + fit.fitted * np.sqrt(share / np.maximum(fit.explained, _TINY))[..., None]
    influence = (1 - share)[..., None] * true**2 - residuals**2
    return influence.var(axis=-1, ddof=1) / fit.centred.var(axis=-1, ddof=1) ** 2


def adjusted_p_values(
    columns: Sequence[NDArray[np.float64]], targets: NDArray[np.float64], *, seed: int, permutations: int = 999
) -> NDArray[np.float64]:
    """Chance that any of several hyperparameters has an F test as significant, where none of them decides anything.

    The targets are permuted over the trials, so that it holds for targets of any distribution, ties among them too.
    Source: Westfall and Young, "Resampling-Based Multiple Testing" (1993), single-step minP.

    Args:
        columns: Of each hyperparameter, (M, K), that vary over the M trials.
        targets: (M,), not all equal.
        seed: Seed of the permutations.
        permutations: Their number.
    """
    shuffled = np.random.default_rng(seed).permuted(np.tile(targets, (permutations, 1)), axis=1)
    smallest = np.min([_p_value(_fit(each, shuffled)) for each in columns], axis=0)
    found = np.array([_p_value(_fit(each, targets)) for each in columns])
    return (1 + np.sum(smallest[:, None] <= found * (1 + 1e-9), axis=0)) / (1 + permutations)


def detectable_share(degrees: int, trials: int, tests: int) -> float:
    """Smallest share of the variance that is found with `POWER`, among so many independent tests (Šidák, 1967).

    Args:
        degrees: Degrees of freedom of the effect.
        trials: Number of trials, more than `degrees` + 1.
        tests: Number of hyperparameters of which any is found by chance in `FAMILY_LEVEL` of the cases.
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
    """Chance of a smaller F if this is the true share, over draws of the scatter of the effect."""
    spread = np.maximum(np.asarray(kurtosis, dtype=np.float64) - 1, 1e-3)[..., None]
    trials = (np.asarray(degrees) + np.asarray(spare) + 1)[..., None]
    scatter = spread * scipy.special.gammaincinv((trials - 1) / spread, _DRAWS)
    odds = (np.asarray(share) / (1 - np.asarray(share)))[..., None]
    freedom = [np.asarray(each, dtype=np.float64)[..., None] for each in (degrees, spare)]
    return scipy.special.ncfdtr(*freedom, odds * scatter, np.asarray(statistic)[..., None]).mean(axis=-1)


def _last_where(holds: Callable[[NDArray], NDArray], like: ArrayLike, steps: int = 24) -> NDArray[np.float64]:
    """Largest share at which something holds that holds for small shares or for none, by bisection."""
    low, high = np.zeros(np.shape(like)), np.full(np.shape(like), _LARGEST_SHARE)
    for _ in range(steps):
        middle = (low + high) / 2
        found = holds(middle)
        low, high = np.where(found, middle, low), np.where(found, high, middle)
    return low
