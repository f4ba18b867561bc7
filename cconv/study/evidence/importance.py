"""Importance of the hyperparameters at each rung, and the smallest importance that so many trials can detect.

The importance is the share of the variance of log10 error that a hyperparameter alone explains, with an interval and a
test (`cconv.study.evidence.effects`). Two other methods are given without intervals, because with few trials no
interval that was tried covers the true value often enough. f-ANOVA (Hutter et al., "An Efficient Approach for Assessing
Hyperparameter Importance", ICML 2014) estimates the same share by a random forest. PED-ANOVA (Watanabe et al., "PED-
ANOVA: Efficiently Quantifying Hyperparameter Importance in Arbitrary Subspaces", IJCAI 2023) measures how much the best
trials differ from all trials in a hyperparameter. All of them need trials that were drawn at random.
"""

import math
from collections.abc import Mapping, Sequence

import numpy as np
import optuna
from numpy.typing import NDArray
from optuna.distributions import BaseDistribution, CategoricalDistribution, FloatDistribution, IntDistribution
from optuna.importance import FanovaImportanceEvaluator, PedAnovaImportanceEvaluator
from optuna.trial import create_trial

from cconv.study.declared.domains import SearchSpace
from cconv.study.evidence.effects import FAMILY_LEVEL, adjusted_p_values, detectable_share, effects
from cconv.study.evidence.surrogate import FEWEST_TRIALS, Axis, axes_of, coordinates, cross_validated_r2, trials_at
from cconv.study.records.found import ParameterImportance, RungImportance
from cconv.study.records.trials import TrialRecord

_TREES = 12
_NONE: dict = {"detectable_share": None, "surrogate_r2": None, "best_share": None, "parameters": {}}
_BEST_SHARE, _FEWEST_BEST = 0.1, 5  # PED-ANOVA's best trials: a tenth, but at least as many as Optuna advises


def importance_by_rung(
    records: Sequence[TrialRecord],
    space: SearchSpace,
    rungs: Sequence[int],
    *,
    useless_error: float,
    seed: int = 0,
) -> list[RungImportance]:
    """Estimate the importance of every hyperparameter at each rung, from the trials with an error at exactly that rung.

    Args:
        records: Trials of one stage that drew at random.
        space: The space that they were drawn from.
        rungs: Numbers of updates, ascending.
        useless_error: Error of predicting the mean, or the error at which trials are given up, if that is smaller;
            larger errors are replaced by it.
        seed: Seed of permutations and forests.

    Returns:
        One entry a rung. It says whether trials are missing because they were stopped before, which makes the others a
        selection. The detectable share holds for every hyperparameter; the R² is that of a forest like f-ANOVA's.
    """
    axes = axes_of(space)
    entries = []
    for previous, updates in zip([0, *rungs], rungs, strict=False):
        trials, targets = trials_at(records, updates, after=previous, useless_error=useless_error)
        points = coordinates(axes, [trial.parameters for trial in trials])
        clipped = int(np.sum(targets == np.log10(useless_error)))
        facts = {
            "updates": updates,
            "trials": len(trials),
            "clipped": clipped,
            "censored": _lacks_stopped(records, trials, updates),
            "why_none": _why_none(axes, points, targets, clipped),
        }
        rng = np.random.default_rng([seed, updates])
        measured = _NONE if facts["why_none"] else _measure(axes, points, targets, int(rng.integers(2**31)))
        entries.append(RungImportance(**facts, **measured))
    return entries


def _lacks_stopped(records: Sequence[TrialRecord], counted: Sequence[TrialRecord], updates: int) -> bool:
    """Tell whether a trial is not counted because it was stopped before these updates."""
    known = {record.id for record in counted}
    stopped = (record for record in records if record.outcome == "stopped" and record.id not in known)
    return any(record.log and record.log[-1]["updates"] < updates for record in stopped)


def _why_none(axes: Sequence[Axis], points: NDArray[np.float64], targets: NDArray[np.float64], clipped: int) -> str:
    """Return the reason why there is no importance, e.g. too few trials or useful ones; or ""."""
    trials = len(targets)
    if trials < FEWEST_TRIALS:
        return f"{trials} trials were measured, and at least {FEWEST_TRIALS} are needed"
    if trials - clipped < max(FEWEST_TRIALS, trials / 2):
        return (
            f"{clipped} of {trials} trials are no better than predicting the mean or were given up, and at least half "
            f"and no fewer than {FEWEST_TRIALS} must be better"
        )
    if np.ptp(targets) == 0:
        return "all errors are equal"
    columns = map(_columns, axes, points.T)
    varies = any(effects(each, targets).is_testable for each in columns)
    return "" if varies else "no hyperparameter varies among the trials"


def _measure(axes: Sequence[Axis], points: NDArray[np.float64], targets: NDArray[np.float64], seed: int) -> dict:
    best = max(_BEST_SHARE, min(_FEWEST_BEST / len(targets), 0.5))
    tested, detectable = _tests(axes, points, targets, seed)
    f_anova = _f_anova(axes, points, targets, seed)
    ped_anova = _ped_anova(axes, points, targets, best)
    return {
        "detectable_share": detectable,
        "surrogate_r2": cross_validated_r2(axes, points, targets, seed=seed),
        "best_share": best,
        "parameters": {
            axis.name: ParameterImportance(
                **tested[axis.name], f_anova=float(f_anova[k]), ped_anova=float(ped_anova[k])
            )
            for k, axis in enumerate(axes)
        },
    }


def _tests(
    axes: Sequence[Axis], points: NDArray[np.float64], targets: NDArray[np.float64], seed: int
) -> tuple[dict[str, dict], float]:
    """Return share, interval and test of each axis, and the share that is detectable for every axis."""
    columns = {axis.name: _columns(axis, points[:, k]) for k, axis in enumerate(axes)}
    found = {name: effects(each, targets) for name, each in columns.items()}
    testable = [name for name, effect in found.items() if effect.is_testable]
    p_values = adjusted_p_values([columns[name] for name in testable], targets, seed=seed)
    untested: dict[str, float | None] = {"share": None, "low": None, "high": None, "p_value": None, "decided": False}
    judged = dict.fromkeys(found, untested)
    for name, p_value in zip(testable, p_values, strict=True):
        low, high = found[name].interval95
        judged[name] = {"share": float(found[name].share), "low": float(low), "high": float(high)}
        judged[name] |= {"p_value": float(p_value), "decided": bool(p_value <= FAMILY_LEVEL)}
    degrees = max(int(found[name].degrees) for name in testable)
    return judged, detectable_share(degrees, len(targets), len(testable))


def _columns(axis: Axis, coordinates: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the terms of the effect of an axis: a parabola for a range, the mean of each value for a choice."""
    if axis.levels is not None:
        return np.equal.outer(coordinates, np.arange(len(axis.levels))).astype(np.float64)
    low, high = axis.bounds
    centred = (coordinates - (low + high) / 2) / (high - low)
    return np.stack([centred, centred**2], axis=-1)


def _f_anova(
    axes: Sequence[Axis], points: NDArray[np.float64], targets: NDArray[np.float64], seed: int
) -> NDArray[np.float64]:
    """Estimate the share of the variance of each axis alone; whole numbers have cells of equal size."""
    distributions = {}
    for axis in axes:
        low, high = axis.bounds
        half = 0.5 if axis.is_whole else 0.0
        distributions[axis.name] = _categories(axis) or FloatDistribution(low - half, high + half)
    evaluator = FanovaImportanceEvaluator(n_trees=_TREES, max_depth=64, seed=seed)
    return _evaluate(evaluator, distributions, points, targets)


def _ped_anova(
    axes: Sequence[Axis], points: NDArray[np.float64], targets: NDArray[np.float64], best_share: float
) -> NDArray[np.float64]:
    """Compute how far the best trials' distribution diverges from that of all trials along each axis, in shares."""
    if np.sort(targets)[math.ceil(best_share * len(targets)) - 1] == targets.max():  # ties make all trials the best
        return np.zeros(len(axes))
    distributions = {}
    for axis in axes:
        low, high = axis.bounds
        numbers = IntDistribution(int(low), int(high)) if axis.is_whole else FloatDistribution(low, high)
        distributions[axis.name] = _categories(axis) or numbers
    evaluator = PedAnovaImportanceEvaluator(target_quantile=best_share, region_quantile=1.0, evaluate_on_local=True)
    divergences = _evaluate(evaluator, distributions, points, targets)
    return divergences / max(divergences.sum(), np.finfo(float).tiny)


def _categories(axis: Axis) -> CategoricalDistribution | None:
    return None if axis.is_ordered else CategoricalDistribution(range(int(axis.bounds[1]) + 1))


def _evaluate(
    evaluator: FanovaImportanceEvaluator | PedAnovaImportanceEvaluator,
    distributions: Mapping[str, BaseDistribution],
    points: NDArray[np.float64],
    targets: NDArray[np.float64],
) -> NDArray[np.float64]:
    optuna.logging.set_verbosity(optuna.logging.WARNING)
    study = optuna.create_study(direction="minimize")
    for point, target in zip(points, targets, strict=True):
        values = {
            name: float(value) if isinstance(distribution, FloatDistribution) else int(value)
            for (name, distribution), value in zip(distributions.items(), point, strict=True)
        }
        study.add_trial(create_trial(params=values, distributions=dict(distributions), value=float(target)))
    found = evaluator.evaluate(study)
    return np.array([found[name] for name in distributions])
