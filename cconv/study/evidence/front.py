"""The Pareto front of error and cost with its uncertainty: hypervolume and attainment."""

import statistics
from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import numpy as np

from cconv.errors import DataError, ShapeError
from cconv.evaluation.statistics import mean_interval, paired_logarithms, times_tie, why_no_interval
from cconv.study.records.summary import AttainmentStep, Hypervolume


@dataclass(frozen=True)
class Timing:
    """Time of a model, timed in turn with others.

    Attributes:
        turns: Time of each turn, ms per frame; in a turn all models predict the same frame on the same machine.
    """

    turns: tuple[float, ...]

    @property
    def ms(self) -> float:
        """Median time, ms per frame."""
        return statistics.median(self.turns)

    def is_slower(self, other: "Timing") -> bool:
        """Tell whether it takes longer than another beyond the noise of the timing, by `times_tie`."""
        return self.ms > other.ms and not times_tie(self.turns, other.turns)


def pareto_front(points: Mapping[str, tuple[float, float]]) -> list[str]:
    """List the names on the Pareto front: no other point is at least as good in both values and better in one.

    Args:
        points: (error, cost) of each name; smaller is better.

    Returns:
        The front, cheapest first.
    """
    front: list[str] = []
    best_error = float("inf")
    for name, (error, _) in sorted(points.items(), key=lambda item: (item[1][1], item[1][0])):
        if error < best_error:
            front.append(name)
            best_error = error
    return front


def timed_front(errors: Mapping[str, float], times: Mapping[str, Timing]) -> list[str]:
    """List the models for which no more accurate one is as fast; times that differ within their noise are ties.

    Args:
        errors: Error of each model.
        times: Time of each model.

    Returns:
        The front, fastest first; errors fall along it.
    """
    order = sorted(errors, key=lambda name: (errors[name], times[name].ms))
    front: list[str] = []
    for name in order:  # from the most accurate on: a model stays if it is faster than all more accurate ones
        if all(times[better].is_slower(times[name]) for better in order[: order.index(name)]):
            front.append(name)
    return front[::-1]


def hypervolume(points: Iterable[tuple[float, float]], reference: tuple[float, float]) -> float:
    """Compute the area that points dominate on log10 axes up to a reference point, in decades of error times cost.

    Source: Zitzler and Thiele, "Multiobjective Evolutionary Algorithms", IEEE Transactions on Evolutionary Computation
    3 (1999). In two dimensions a sweep along the cost is exact.

    Args:
        points: (error, cost) of each model, positive; those beyond the reference dominate nothing.
        reference: (error, cost) of the corner; areas can only be compared for the same corner.
    """
    corner_error, corner_cost = np.log10(reference)
    logarithms = [tuple(np.log10(point)) for point in points]
    inside = [(cost, error) for error, cost in logarithms if error < corner_error and cost < corner_cost]
    area, lowest = 0.0, corner_error
    for cost, error in sorted(inside):
        if error < lowest:
            area += (lowest - error) * (corner_cost - cost)
            lowest = error
    return float(area)


def hypervolume_interval(
    errors: Mapping[str, np.ndarray], cost: Mapping[str, float], reference: tuple[float, float]
) -> Hypervolume:
    """Compute the hypervolume of the geometric mean errors of all models, with its 95 % interval over seeds and units.

    On logarithmic axes the area is a sum of the logarithms of the errors on the front times the steps in cost. So each
    seed and unit has an area of its own, and the interval is that of their mean. It assumes that the models on the
    front are the same for other seeds and units.

    Args:
        errors: Errors (seeds, units) by model, with the same units.
        cost: Cost by model, e.g. ms per frame.
        reference: (error, cost) of the corner.

    Returns:
        The hypervolume; its reference is (cost, error), in the order of the axes of a chart.

    Raises:
        ShapeError: If the models differ in their units.
        DataError: If there is no model, or one has no cost.
    """
    _check(errors, cost)
    logarithms = dict(
        zip(errors, (table / np.log(10) for table in paired_logarithms(list(errors.values()))), strict=True)
    )
    typical = {name: (10 ** float(table.mean()), cost[name]) for name, table in logarithms.items()}
    area = hypervolume(typical.values(), reference)
    corner_error, corner_cost = reference
    inside = {name: point for name, point in typical.items() if point[0] < corner_error and point[1] < corner_cost}
    front = pareto_front(inside)
    steps = np.diff(np.log10([*(cost[name] for name in front), corner_cost]))
    shape = next(iter(logarithms.values())).shape
    deviations = sum(
        (step * (table.mean() - table) for step, table in zip(steps, map(logarithms.__getitem__, front), strict=True)),
        np.zeros(shape),
    )
    interval = mean_interval(area + deviations)
    return Hypervolume(
        value=area,
        ci95=None if interval is None else (max(interval[0], 0.0), interval[1]),
        why_no_interval=why_no_interval(*shape),
        reference=(float(corner_cost), float(corner_error)),
    )


def attainment(
    errors: Mapping[str, np.ndarray],
    cost: Mapping[str, float],
    *,
    levels: tuple[float, float] = (0.1, 0.9),
    draws: int = 1000,
    seed: int = 0,
) -> list[AttainmentStep]:
    """Compute the error that one training of each model attains at a cost, as a band of step functions.

    A draw takes one seed of each model and its mean error over the units. The error that the draw attains at a cost is
    the smallest one among the models of at most that cost. The band describes the seeds that were trained and is no
    confidence interval: other seeds may fall outside it more often.

    Source: Grunert da Fonseca, Fonseca and Hall, "Inferential Performance Assessment of Stochastic Optimisers and the
    Attainment Function" (EMO 2001).

    Args:
        errors: Errors (seeds, units) by model.
        cost: Cost by model.
        levels: Shares of draws that attain the lower and the upper edge of the band.
        draws: Number of draws.
        seed: Seed of the draws.

    Returns:
        A step at the cost of each model, in ascending order.

    Raises:
        ShapeError: If the models differ in their units.
        DataError: If there is no model, or none has a cost.
    """
    _check(errors, cost)
    rng, names = np.random.default_rng(seed), sorted(errors, key=cost.__getitem__)
    drawn = np.stack([rng.choice(errors[name].mean(axis=1), draws) for name in names], axis=1)
    attained = np.minimum.accumulate(drawn, axis=1)
    low, median, high = np.quantile(attained, (levels[0], 0.5, levels[1]), axis=0).tolist()
    steps = zip(names, median, low, high, strict=True)
    return [
        AttainmentStep(ms_per_frame=cost[name], median=middle, low=lowest, high=highest)
        for name, middle, lowest, highest in steps
    ]


def _check(errors: Mapping[str, np.ndarray], cost: Mapping[str, float]) -> None:
    if not errors or errors.keys() - cost.keys():
        missing = ", ".join(sorted(errors.keys() - cost.keys())) or "every model"
        raise DataError(f"a front needs error and cost of each model; missing: {missing}.")
    shapes = {name: np.shape(table) for name, table in errors.items()}
    if any(len(shape) != 2 for shape in shapes.values()) or len({shape[1] for shape in shapes.values()}) > 1:
        raise ShapeError(f"errors must have shape (seeds, units) with the same units for every model, got {shapes}.")
