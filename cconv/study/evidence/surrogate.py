"""Trials at one number of updates as coordinates and targets, and a random forest that predicts the error from them."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from sklearn.ensemble import RandomForestRegressor

from cconv.errors import DataError
from cconv.study.declared.domains import Parameter, SearchSpace
from cconv.study.records.trials import TrialRecord
from cconv.validation import Value

FEWEST_TRIALS = 10  # fewer show nothing about a dozen hyperparameters


@dataclass(frozen=True)
class Axis:
    """A hyperparameter as a coordinate that the space draws uniformly.

    Attributes:
        name: Name of the hyperparameter.
        bounds: Smallest and largest coordinate.
        levels: Values of a choice, whose coordinates are their positions; None for a range.
        is_ordered: Whether neighbouring coordinates are neighbouring values, which is not so for words.
        is_whole: Whether coordinates are whole numbers.
        is_log: Whether the coordinate is the decimal logarithm of the value.
        baseline: Value of a configuration without the hyperparameter.
    """

    name: str
    bounds: tuple[float, float]
    levels: "tuple[Value, ...] | None" = None
    is_ordered: bool = True
    is_whole: bool = False
    is_log: bool = False
    baseline: Value | None = None

    @classmethod
    def of(cls, name: str, parameter: Parameter) -> "Axis":
        """Make the axis of a hyperparameter of a space."""
        if parameter.type == "choice":
            ordered = not any(isinstance(value, str) for value in parameter.values)
            levels = tuple(sorted(parameter.values) if ordered else parameter.values)
            return cls(name, (0.0, len(levels) - 1.0), levels, ordered, is_whole=True, baseline=parameter.baseline)
        log = parameter.scale == "log"
        low, high = np.log10(parameter.range) if log else parameter.range
        whole = parameter.type == "int" and not log
        return cls(name, (float(low), float(high)), is_whole=whole, is_log=log, baseline=parameter.baseline)

    def encode(self, value: Value) -> float:
        """Return the coordinate of a value.

        Raises:
            DataError: If the space does not have the value.
        """
        low, high = self.bounds
        if self.levels is not None:
            coordinate = float(self.levels.index(value)) if value in self.levels else -1.0
        else:
            coordinate = float(np.log10(value) if self.is_log else value)
        if not low <= coordinate <= high:
            domain = list(self.levels or (self.decode(low), self.decode(high)))
            raise DataError(f"`{self.name}` = {value!r} is not in {domain}; give the space that the trials came from.")
        return coordinate

    def decode(self, coordinate: float) -> Value:
        """Return the value at a coordinate."""
        if self.levels is not None:
            return self.levels[round(coordinate)]
        return int(coordinate) if self.is_whole else float(10**coordinate if self.is_log else coordinate)


def axes_of(space: SearchSpace) -> list[Axis]:
    """Make the axes of the hyperparameters that have more than one value, in the order of the space."""
    axes = [Axis.of(name, parameter) for name, parameter in space.parameters.items()]
    return [axis for axis in axes if axis.bounds[0] < axis.bounds[1]]


def coordinates(axes: Sequence[Axis], parameters: Iterable[Mapping]) -> NDArray[np.float64]:
    """Return coordinates (M, P) of M configurations; a hyperparameter that is inactive has its baseline value."""
    rows = [[axis.encode(drawn.get(axis.name, axis.baseline)) for axis in axes] for drawn in parameters]
    return np.array(rows, dtype=np.float64).reshape(-1, len(axes))


def trials_at(
    records: Sequence[TrialRecord], updates: int, after: int = 0, *, useless_error: float
) -> tuple[list[TrialRecord], NDArray[np.float64]]:
    """Return the trials with an error at exactly this number of updates, and log10 of those errors.

    A trial that diverged or was given up with a useless error between `after` and these updates is included. Its error,
    like every larger one, is replaced by the useless error: how much worse than predicting the mean a model is shows
    nothing about good models, but would cause most of the variance.

    Args:
        records: The trials.
        updates: Number of gradient updates.
        after: Updates of the rung before.
        useless_error: Error of predicting the mean on the validation split, or the error at which trials are given up,
            if that is smaller.
    """
    errors = {record.id: _error_at(record, updates, after, useless_error) for record in records}
    measured = [record for record in records if errors[record.id] is not None]
    values = np.array([errors[record.id] for record in measured], dtype=np.float64)
    return measured, np.log10(np.clip(values, np.finfo(float).tiny, useless_error))


def _error_at(record: TrialRecord, updates: int, after: int, useless_error: float) -> float | None:
    if record.log and after < record.log[-1]["updates"] <= updates:
        error = record.log[-1]["valid_error"]
        useless = error is None or error > useless_error
        if record.outcome == "diverged" or (record.outcome == "stopped" and useless):
            return useless_error
    return record.error_at(updates)


class Surrogate:
    """A random forest over coordinates, in which every word of a choice is a column.

    Source: Breiman, "Random Forests", Machine Learning 45 (2001).

    Args:
        axes: Axes of the coordinates.
        trees: Number of trees.
        seed: Seed of their bootstrap samples.
    """

    def __init__(self, axes: Sequence[Axis], *, trees: int = 64, seed: int = 0):
        self._axes = list(axes)
        self._forest = RandomForestRegressor(n_estimators=trees, random_state=seed)

    def fit(self, coordinates: NDArray[np.float64], targets: NDArray[np.float64]) -> "Surrogate":
        """Fit the forest to targets (M,) at coordinates (M, P)."""
        self._forest.fit(self._columns(coordinates), targets)
        return self

    def predict(self, coordinates: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return predictions (M,) at coordinates (M, P)."""
        return self._forest.predict(self._columns(coordinates))

    def predict_by_tree(self, coordinates: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the predictions (trees, M) of the single trees at coordinates (M, P)."""
        columns = self._columns(coordinates)
        return np.stack([tree.predict(columns) for tree in self._forest.estimators_])

    def _columns(self, coordinates: NDArray[np.float64]) -> NDArray[np.float64]:
        columns = [
            column[:, None] if axis.is_ordered else np.equal.outer(column, np.arange(axis.bounds[1] + 1))
            for axis, column in zip(self._axes, coordinates.T, strict=True)
        ]
        return np.hstack(columns).astype(np.float64)


def cross_validated_r2(
    axes: Sequence[Axis], coordinates: NDArray[np.float64], targets: NDArray[np.float64], *, seed: int
) -> float | None:
    """Compute R² of a surrogate on unseen trials by fivefold cross-validation; None if all targets are equal.

    It is at most 1. If it is 0 or less, the surrogate is no better than the mean, and its importances mean nothing.
    """
    scatter = np.sum((targets - targets.mean()) ** 2)
    if scatter == 0:
        return None
    folds = np.array_split(np.random.default_rng(seed).permutation(len(targets)), 5)
    residuals = []
    for held_out in folds:
        seen = np.setdiff1d(np.arange(len(targets)), held_out)
        surrogate = Surrogate(axes, seed=seed).fit(coordinates[seen], targets[seen])
        residuals.append(targets[held_out] - surrogate.predict(coordinates[held_out]))
    return float(1 - np.sum(np.concatenate(residuals) ** 2) / scatter)
