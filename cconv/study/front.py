"""The front of error against cost with its uncertainty: hypervolume, and what is attained at each cost."""

from collections.abc import Iterable, Mapping

import numpy as np

from cconv.errors import DataError, ShapeError


def hypervolume(points: Iterable[tuple[float, float]], reference: tuple[float, float]) -> float:
    """Area that points dominate on log10 axes, up to a reference point, in decades of error times decades of cost.

    Source: Zitzler and Thiele, "Multiobjective Evolutionary Algorithms", IEEE Transactions on Evolutionary Computation
    3 (1999). In two dimensions a sweep along the cost is exact.

    Args:
        points: (error, cost) of each model, positive; those beyond the reference dominate nothing.
        reference: (error, cost) of the corner; store it, as areas compare only for the same one.
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


def bootstrap_hypervolume(
    errors: Mapping[str, np.ndarray],
    cost: Mapping[str, float],
    reference: tuple[float, float],
    *,
    resamples: int = 1000,
    seed: int = 0,
) -> dict:
    """Hypervolume of the mean errors, with the percentile interval of seeds and units redrawn.

    The same units are redrawn for all models, and the same seeds for those that have as many.

    Args:
        errors: Errors (seeds, units) by model; the units are those of all models.
        cost: Cost by model, e.g. ms per frame.
        reference: (error, cost) of the corner.
        resamples: Bootstrap resamples.
        seed: Seed of the resampling.

    Returns:
        "hypervolume", "ci95" and "reference".

    Raises:
        ShapeError: If the models differ in their units.
        DataError: If there is no model, or none has a cost.
    """
    _check(errors, cost)
    means = _redrawn_means(errors, resamples, seed)
    costs = [cost[name] for name in errors]
    areas = [hypervolume(zip(row, costs, strict=True), reference) for row in means]
    of_means = hypervolume([(float(np.mean(errors[name])), cost[name]) for name in errors], reference)
    interval = [float(end) for end in np.percentile(areas, (2.5, 97.5))]
    return {"hypervolume": of_means, "ci95": interval, "reference": [float(value) for value in reference]}


def attainment(
    errors: Mapping[str, np.ndarray],
    cost: Mapping[str, float],
    *,
    levels: tuple[float, float] = (0.1, 0.9),
    draws: int = 1000,
    seed: int = 0,
) -> dict[str, list[float]]:
    """Error that one training of each model attains at a cost: a band of step functions.

    A draw takes one seed of each model, and its mean error over the units; the smallest error among the models of at
    most a given cost is what it attains there. Source: Grunert da Fonseca, Fonseca and Hall, "Inferential Performance
    Assessment of Stochastic Optimisers and the Attainment Function" (EMO 2001).

    Args:
        errors: Errors (seeds, units) by model.
        cost: Cost by model.
        levels: Shares of draws that attain the lower and the upper edge of the band.
        draws: Number of draws.
        seed: Seed of the draws.

    Returns:
        "cost", the models' costs in ascending order, where the steps are; "low", "median" and "high", errors there.

    Raises:
        ShapeError: If the models differ in their units.
        DataError: If there is no model, or none has a cost.
    """
    _check(errors, cost)
    rng, names = np.random.default_rng(seed), sorted(errors, key=cost.__getitem__)
    drawn = np.stack([rng.choice(errors[name].mean(axis=1), draws) for name in names], axis=1)
    attained = np.minimum.accumulate(drawn, axis=1)
    low, median, high = np.quantile(attained, (levels[0], 0.5, levels[1]), axis=0).tolist()
    return {"cost": [float(cost[name]) for name in names], "low": low, "median": median, "high": high}


def _redrawn_means(errors: Mapping[str, np.ndarray], resamples: int, seed: int) -> np.ndarray:
    """Mean error of each model in each resample, (resamples, models)."""
    rng = np.random.default_rng(seed)
    units = next(iter(errors.values())).shape[1]
    columns = rng.integers(units, size=(resamples, 1, units))
    rows = {
        count: rng.integers(count, size=(resamples, count, 1)) for count in sorted({len(e) for e in errors.values()})
    }
    return np.stack([table[rows[len(table)], columns].mean(axis=(1, 2)) for table in errors.values()], axis=1)


def _check(errors: Mapping[str, np.ndarray], cost: Mapping[str, float]) -> None:
    if not errors or errors.keys() - cost.keys():
        missing = ", ".join(sorted(errors.keys() - cost.keys())) or "every model"
        raise DataError(f"a front needs error and cost of each model; missing: {missing}.")
    shapes = {name: np.shape(table) for name, table in errors.items()}
    if any(len(shape) != 2 for shape in shapes.values()) or len({shape[1] for shape in shapes.values()}) > 1:
        raise ShapeError(f"errors must have shape (seeds, units) with the same units for every model, got {shapes}.")
