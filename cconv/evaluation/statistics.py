r"""Confidence intervals of errors over several seeds and units: of a mean error, and of the ratio of two models.

A unit is a trajectory, or a block of frames of a single one. Seeds and units are crossed, so the cells of one
row or column are not independent draws. Errors are positive and span decades; the intervals hold for logarithms that
are normal, with an effect of the seed, one of the unit, and one of both. tests/evaluation/test_coverage.py simulates
how often each of them holds the true value.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy.special

from cconv.errors import ConfigError, DataError, ShapeError

RESOLUTION = 0.05  # relative difference of two times that is too small to choose a model by

FEWEST = 4  # smallest number of seeds or units with an interval
SMALLEST_ERROR = 1e-14  # share of the variance: the square of the resolution of float32; smaller errors count as this
_DRAWS = 20_000


@dataclass(frozen=True, kw_only=True)
class PairedRatio:
    """Ratio of the errors of one model to those of a reference, paired by seed and unit.

    Attributes:
        ratio: Geometric mean of the ratios of errors.
        log_ratio: Its natural logarithm.
        log_standard_error: Standard error of `log_ratio` over seeds and units; 0 if there is only one value.
        ci95: 95 % interval of `ratio` over other seeds and units; None if `why_no_interval` has a reason.
    """

    ratio: float
    log_ratio: float
    log_standard_error: float
    ci95: tuple[float, float] | None


def why_no_interval(seeds: int, units: int) -> str:
    """Return the reason why so few draws give no reliable 95 % interval, or "".

    With fewer than `FEWEST` units, or two or three seeds, the simulated intervals of every kind that was tried cover 48
    to 93 %, or span many decades. A single seed means one fit, whose interval covers the units only.

    Args:
        seeds: Number of seeds; 1 for a closed form.
        units: Number of units.
    """
    needed = f"too little of others; at least {FEWEST} are needed"
    if units < FEWEST:
        return f"1 unit says {needed}" if units == 1 else f"{units} units say {needed}"
    if 1 < seeds < FEWEST:
        return f"{seeds} seeds say {needed}"
    return ""


def crossed_interval(errors: np.ndarray, *, seed: int = 0) -> tuple[float, float] | None:
    r"""Compute the 95 % interval of a model's mean error over all possible seeds and units.

    It is a generalised confidence interval: the effects of seed a, unit b and both c of the logarithms are normal, the
    mean is :math:`\exp(\mu + (\sigma_a^2 + \sigma_b^2 + \sigma_c^2) / 2)`, and the unknown variances are what the sums
    of squares of the table leave possible, :math:`SS / \chi^2`. The upper end is large with few units, because other
    units may be much harder. Sources: Weerahandi, "Generalized Confidence Intervals", JASA 88 (1993);
    Krishnamoorthy and Mathew, "Inferences on the means of lognormal distributions using generalized p-values and
    generalized confidence intervals", J. Statistical Planning and Inference 115 (2003).

    Args:
        errors: Errors (seeds, units), positive; one row for a model without seeds.
        seed: Seed of the draws.

    Returns:
        Lower and upper end; None if `why_no_interval` has a reason.

    Raises:
        ShapeError: If `errors` is no table.
        DataError: If an error is negative or not finite.
    """
    logarithms = _logarithms(errors)
    seeds, units = logarithms.shape
    if why_no_interval(seeds, units):
        return None
    rng = np.random.default_rng(seed)
    rows, columns, both = _sums_of_squares(logarithms)
    of_both = both / rng.chisquare(max((seeds - 1) * (units - 1), 1), _DRAWS)
    of_seeds = np.maximum(rows / rng.chisquare(max(seeds - 1, 1), _DRAWS) - of_both, 0) / units
    of_units = np.maximum(columns / rng.chisquare(units - 1, _DRAWS) - of_both, 0) / seeds
    spread = np.sqrt(of_seeds / seeds + of_units / units + of_both / (seeds * units))
    means = logarithms.mean() + rng.standard_normal(_DRAWS) * spread + (of_seeds + of_units + of_both) / 2
    low, high = np.exp(np.minimum(np.quantile(means, (0.025, 0.975)), math.log(1e300)))
    return float(low), float(high)


def interval_beside(mean: float, errors: np.ndarray) -> tuple[float, float] | None:
    """Compute `crossed_interval`, widened to hold the mean error that is told beside it, if that is outside.

    Args:
        mean: The mean error as it is told, e.g. over samples instead of units, or rounded otherwise.
        errors: As of `crossed_interval`.
    """
    interval = crossed_interval(errors)
    return None if interval is None else (min(interval[0], mean), max(interval[1], mean))


def paired_ratio(ours: np.ndarray, reference: np.ndarray) -> PairedRatio:
    """Compare the errors of a model with those of a reference on the same seeds and units.

    Effects of a unit on both models cancel in the ratio. The interval is Student's t on the logarithms, with
    the standard error and degrees of freedom of `crossed_standard_error`.

    Args:
        ours: Errors (seeds, units); a model without seeds has one row, which counts for every seed.
        reference: Errors of the reference, likewise, with the same units.

    Raises:
        ShapeError: If the two cannot be paired.
        DataError: If an error is negative or not finite.
    """
    ours, reference = paired_logarithms([ours, reference])
    differences = ours - reference
    interval = mean_interval(differences)
    return PairedRatio(
        ratio=math.exp(differences.mean()),
        log_ratio=float(differences.mean()),
        log_standard_error=crossed_standard_error(differences)[0],
        ci95=None if interval is None else (math.exp(interval[0]), math.exp(interval[1])),
    )


def mean_interval(values: np.ndarray) -> tuple[float, float] | None:
    """Compute the 95 % interval of the mean of a normal table (seeds, units) by Student's t; None for too few draws."""
    if why_no_interval(*values.shape):
        return None
    error, freedom = crossed_standard_error(values)
    width = scipy.special.stdtrit(freedom, 0.975) * error if error else 0.0
    return float(values.mean() - width), float(values.mean() + width)


def crossed_standard_error(values: np.ndarray) -> tuple[float, float]:
    r"""Standard error of the mean of a table whose rows and columns are both draws of many, and its degrees of freedom.

    The error is :math:`\sqrt{s_a^2/A + s_b^2/B}` with the variances of the means of rows and of columns. Source of the
    degrees of freedom: Satterthwaite, Biometrics Bulletin 2 (1946).

    Args:
        values: Table (seeds, units).

    Returns:
        The error and the degrees of freedom; 0 and infinity where nothing varies.
    """
    means = [mean for mean in (values.mean(axis=1), values.mean(axis=0)) if len(mean) > 1]
    parts = [mean.var(ddof=1) / len(mean) for mean in means]
    variance = sum(parts)
    if variance == 0:
        return 0.0, math.inf
    freedom = variance**2 / sum(part**2 / (len(mean) - 1) for part, mean in zip(parts, means, strict=True))
    return float(np.sqrt(variance)), float(freedom)


def paired_logarithms(tables: list[np.ndarray]) -> list[np.ndarray]:
    """Take logarithms of tables of errors (seeds, units), and repeat tables of one row for the seeds of the others.

    Raises:
        ShapeError: If they differ in their units or seeds.
        DataError: If an error is negative or not finite.
    """
    logarithms = [_logarithms(table) for table in tables]
    shapes = [table.shape for table in logarithms]
    if len({rows for rows, _ in shapes} - {1}) > 1 or len({units for _, units in shapes}) > 1:
        raise ShapeError(
            f"errors of shapes {', '.join(map(str, shapes))} cannot be paired: give all the same seeds (or one row, "
            "for a model without seeds) and the same units."
        )
    return list(np.broadcast_arrays(*logarithms))


def _logarithms(errors: np.ndarray) -> np.ndarray:
    errors = np.asarray(errors, dtype=float)
    if errors.ndim != 2 or errors.size == 0:
        raise ShapeError(f"errors must have shape (seeds, units), got {errors.shape}.")
    if not np.isfinite(errors).all() or errors.min() < 0:
        raise DataError("errors must be finite and not negative; leave models with a diverged seed out.")
    return np.log(np.maximum(errors, SMALLEST_ERROR))


def _sums_of_squares(table: np.ndarray) -> tuple[float, float, float]:
    """Sums of squares of rows, columns and what is left, of a two-way table without replication."""
    rows, columns = table.mean(axis=1, keepdims=True), table.mean(axis=0, keepdims=True)
    left = table - rows - columns + table.mean()
    seeds, units = table.shape
    return units * float(rows.var()) * seeds, seeds * float(columns.var()) * units, float((left**2).sum())


def times_tie(ours: Sequence[float], other: Sequence[float]) -> bool:
    """Tell whether the times of two models, measured in turn, are equal within their noise.

    A sign test on paired turns: the 95 % interval of the median ratio of the two times in a turn, from order statistics
    by the binomial distribution (Conover, Practical Nonparametric Statistics, 1999, section 3.2), must include 1 or
    come closer to it than `RESOLUTION`. With fewer than six turns all times tie.

    Args:
        ours: Time of each turn, such as `Cost.turns_ms`.
        other: Times of the other model in the same turns.

    Raises:
        ConfigError: If the numbers of turns differ.
    """
    if len(ours) != len(other):
        raise ConfigError(
            f"`ours` and `other` must be times of the same turns, got {len(ours)} and {len(other)}; "
            "measure both in one run."
        )
    ratios = sorted(first / second for first, second in zip(ours, other, strict=True))
    below = int(scipy.stats.binom.ppf(0.025, len(ratios), 0.5))  # the largest number with P(fewer) <= 0.025
    if below == 0:
        return True
    low, high = ratios[below - 1], ratios[-below]
    return low <= 1 + RESOLUTION and high >= 1 / (1 + RESOLUTION)
