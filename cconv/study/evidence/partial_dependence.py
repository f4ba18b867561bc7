"""Partial dependence of the error on one hyperparameter by a surrogate, with the trials that it was fitted to."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from cconv.errors import ConfigError
from cconv.study.declared.domains import SearchSpace
from cconv.study.evidence.surrogate import (
    FEWEST_TRIALS,
    Axis,
    Surrogate,
    axes_of,
    coordinates,
    cross_validated_r2,
    trials_at,
)
from cconv.study.records.found import PartialDependence, TrialPoint
from cconv.study.records.trials import TrialRecord


def partial_dependence(
    records: Sequence[TrialRecord],
    space: SearchSpace,
    updates: int,
    parameter: str,
    *,
    useless_error: float,
    seed: int = 0,
) -> PartialDependence:
    """Estimate by a random forest how the error depends on one hyperparameter while the others are as in the trials.

    Source: Friedman, "Greedy Function Approximation", Ann. Statist. 29 (2001), section 8.2, on log10 error.

    Args:
        records: Trials of one stage that drew at random.
        space: The space that they were drawn from.
        updates: Number of gradient updates of the errors.
        parameter: The hyperparameter.
        useless_error: Largest error; larger ones are replaced by it, as in `cconv.study.evidence.importance`.
        seed: Seed of the forest.

    Returns:
        The mean error at values of the hyperparameter, the range of the middle 80 % of the forest's trees, which is no
        confidence interval, and the values and errors of the trials.

    Raises:
        ConfigError: If the space does not vary the hyperparameter, or fewer than ten trials have an error after these
            updates.
    """
    axes = axes_of(space)
    names = [axis.name for axis in axes]
    trials, targets = trials_at(records, updates, useless_error=useless_error)
    if parameter not in names:
        raise ConfigError(f"`{parameter}` does not vary in the space; those that do: {', '.join(names)}.")
    if len(trials) < FEWEST_TRIALS:
        raise ConfigError(
            f"{len(trials)} trials have an error after {updates} updates; a surrogate needs {FEWEST_TRIALS}."
        )
    number, points = names.index(parameter), coordinates(axes, [trial.parameters for trial in trials])
    axis = axes[number]
    grid = _grid(axis)
    means = _means_by_tree(Surrogate(axes, seed=seed).fit(points, targets), points, number, grid)
    low, high = np.percentile(means, (10, 90), axis=0)
    return PartialDependence(
        parameter=parameter,
        scale=_scale(axis),
        updates=updates,
        trials=len(trials),
        surrogate_r2=cross_validated_r2(axes, points, targets, seed=seed),
        values=[axis.decode(coordinate) for coordinate in grid],
        error=(10 ** means.mean(axis=0)).tolist(),
        low=(10**low).tolist(),
        high=(10**high).tolist(),
        points=[
            TrialPoint(value=axis.decode(point), error=float(10**target))
            for point, target, trial in zip(points[:, number], targets, trials, strict=True)
            if parameter in trial.parameters
        ],
    )


def _scale(axis: Axis) -> str:
    return "choice" if axis.levels is not None else "log" if axis.is_log else "linear"


def _grid(axis: Axis, steps: int = 25) -> NDArray[np.float64]:
    low, high = axis.bounds
    if axis.is_whole:
        return np.unique(np.linspace(low, high, steps).round())
    return np.linspace(low, high, steps)


def _means_by_tree(
    surrogate: Surrogate, points: NDArray[np.float64], number: int, grid: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Compute the mean prediction (trees, values) with one coordinate of all points set to each value of the grid."""
    moved = np.repeat(points[None], len(grid), axis=0)
    moved[:, :, number] = grid[:, None]
    predictions = surrogate.predict_by_tree(moved.reshape(-1, points.shape[1]))
    return predictions.reshape(-1, len(grid), len(points)).mean(axis=2)
