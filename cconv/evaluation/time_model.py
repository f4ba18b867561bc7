"""A model of the time of a prediction from its counted cost, fitted to measured models, with its errors."""

import statistics
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import nnls
from scipy.stats import spearmanr

from cconv.errors import ConfigError
from cconv.networks.counting import CountedCost


@dataclass(frozen=True, kw_only=True)
class TimeModel:
    """Time = a + b · operations + c · bytes, on one machine with one number of threads.

    Attributes:
        us_per_particle: a, µs.
        us_per_flop: b, µs.
        us_per_byte: c, µs.
    """

    us_per_particle: float
    us_per_flop: float
    us_per_byte: float

    @classmethod
    def fit(cls, estimates: Sequence[CountedCost], times: Sequence[float]) -> "TimeModel":
        """Fit non-negative coefficients with the smallest squared relative errors.

        Args:
            estimates: Counted costs of measured models.
            times: Their times, µs per particle, positive.
        """
        terms = np.array([_terms(each) for each in estimates]) / np.array(times)[:, None]
        scales = np.linalg.norm(terms, axis=0)
        scales[scales == 0] = 1.0
        values, _ = nnls(terms / scales, np.ones(len(terms)))
        constant, of_flops, of_bytes = (values / scales).tolist()
        return cls(us_per_particle=constant, us_per_flop=of_flops, us_per_byte=of_bytes)

    def predict(self, estimate: CountedCost) -> float:
        """Return the time of a prediction per particle, µs."""
        return float(np.dot(_terms(estimate), (self.us_per_particle, self.us_per_flop, self.us_per_byte)))


@dataclass(frozen=True, kw_only=True)
class CostModelCheck:
    """Predicted against measured times.

    Attributes:
        time_model: Fitted to all models.
        measured: Time of each model, µs per particle.
        predicted: Time of each model by coefficients that were fitted to the others, µs per particle.
        relative_errors: Predicted over measured, minus 1.
        median_relative_error: Median of their absolute values.
        rank_correlation: Spearman's, of predicted with measured times.
    """

    time_model: TimeModel
    measured: dict[str, float]
    predicted: dict[str, float]
    relative_errors: dict[str, float]
    median_relative_error: float
    rank_correlation: float


def check_cost_model(estimates: Mapping[str, CountedCost], measured: Mapping[str, float]) -> CostModelCheck:
    """Measure how well times follow from counted costs by leave-one-out: each model is predicted from the others.

    Args:
        estimates: Counted cost of each model.
        measured: Its time, µs per particle, in one run.

    Raises:
        ConfigError: If the names differ, or there are fewer than five models.
    """
    names = list(measured)
    if len(names) < 5 or estimates.keys() != measured.keys():
        raise ConfigError(
            f"`estimates` and `measured` must name the same models, at least 5, got {sorted(estimates)} and "
            f"{sorted(measured)}; three coefficients and a check need more than that."
        )
    counted, times = [estimates[name] for name in names], [measured[name] for name in names]
    predicted = {}
    for place, name in enumerate(names):
        others = TimeModel.fit(counted[:place] + counted[place + 1 :], times[:place] + times[place + 1 :])
        predicted[name] = others.predict(estimates[name])
    errors = {name: predicted[name] / measured[name] - 1 for name in names}
    return CostModelCheck(
        time_model=TimeModel.fit(counted, times),
        measured=dict(measured),
        predicted=predicted,
        relative_errors=errors,
        median_relative_error=statistics.median(abs(error) for error in errors.values()),
        rank_correlation=float(spearmanr(times, list(predicted.values())).statistic),
    )


def _terms(estimate: CountedCost) -> tuple[float, float, float]:
    return 1.0, estimate.flops_per_particle, estimate.bytes_per_particle
