"""Which hyperparameters decide the error, at each rung apart, with intervals and a floor below which all is noise.

Two questions, two methods. f-ANOVA (Hutter et al., "An Efficient Approach for Assessing Hyperparameter Importance",
ICML 2014): which share of the variance of log10 error over the whole space is due to a hyperparameter alone?
PED-ANOVA (Watanabe et al., "PED-ANOVA: Efficiently Quantifying Hyperparameter Importance in Arbitrary Subspaces", IJCAI
2023): by which hyperparameters do the best trials differ from all? Both belong on trials that were drawn at random.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import TYPE_CHECKING

import numpy as np
import optuna
from numpy.typing import NDArray
from optuna.distributions import BaseDistribution, CategoricalDistribution, FloatDistribution, IntDistribution
from optuna.importance import FanovaImportanceEvaluator, PedAnovaImportanceEvaluator
from optuna.trial import create_trial

from cconv.study.records import TrialRecord
from cconv.study.surrogate import FEWEST_TRIALS, Axis, axes_of, coordinates, cross_validated_r2, trials_at

if TYPE_CHECKING:  # spaces need torch, which readers of records need not load
    from cconv.study.space import SearchSpace

Method = Callable[[Sequence[Axis], NDArray[np.float64], NDArray[np.float64], int], NDArray[np.float64]]

LEVELS = (2.5, 97.5)  # percent
_TREES = 12
_BEST_SHARE, _FEWEST_BEST = 0.1, 5  # PED-ANOVA's best trials: a tenth, but no fewer than Optuna advises
_DUMMY = Axis("(dummy)", (0.0, 1.0))


def importance_by_rung(
    records: Sequence[TrialRecord],
    space: "SearchSpace",
    rungs: Sequence[int],
    *,
    useless_error: float,
    seed: int = 0,
    resamples: int = 50,
) -> list[dict]:
    """Importance of every hyperparameter at each rung, from the trials that have an error at exactly that rung.

    Intervals are percentiles over resampled trials; a resample has fewer distinct trials, so that an interval may lie
    below the importance itself. Each resample has a hyperparameter more, a dummy: a random permutation of evenly spaced
    numbers. The floor of noise is the upper end of the dummy's interval, and what exceeds it is above noise; for
    f-ANOVA only if the surrogate predicts trials that it has not seen. Of what is below nothing is known: weak is shown
    by the upper end of an interval. To ask that the lower end exceed the floor is too strict: in 8 simulations of 40
    trials and 15 hyperparameters it missed seven times a choice that made up a third of the variance. This rule
    missed it once, and took about one of a hundred hyperparameters without influence for one with.

    Args:
        records: Trials of one stage that drew at random.
        space: The space that they were drawn from.
        rungs: Numbers of updates, ascending.
        useless_error: Error of predicting the mean, up to which errors count.
        seed: Of resamples, dummies and forests.
        resamples: Number of resamples.

    Returns:
        One entry a rung with at least ten trials and errors that differ: "updates", "trials"; "censored", whether some
        trials were stopped before, so that what is left is a selection by error; "clipped", how many count with the
        useless error; "surrogate_r2", cross-validated; and for "f_anova" and "ped_anova" their settings, "noise_floor"
        and "parameters", which gives "importance", "low", "high", "above_noise" for each. f-ANOVA's are shares of the
        variance, whose rest is interactions; PED-ANOVA's are shares of the sum over all hyperparameters.
    """
    axes = axes_of(space)
    entries = []
    for previous, updates in zip([0, *rungs], rungs, strict=False):
        trials, targets = trials_at(records, updates, after=previous, useless_error=useless_error)
        if len(trials) >= FEWEST_TRIALS and np.ptp(targets) > 0:
            points = coordinates(axes, [trial.parameters for trial in trials])
            entry = _entry(axes, points, targets, np.random.default_rng([seed, updates]), resamples)
            clipped = int(np.sum(targets == np.log10(useless_error)))
            facts = {"updates": updates, "censored": _stopped_by(records, previous), "clipped": clipped}
            entries.append(facts | entry)
    return entries


def _stopped_by(records: Sequence[TrialRecord], updates: int) -> bool:
    return any(record.outcome == "stopped" and record.log[-1]["updates"] <= updates for record in records)


def _entry(
    axes: Sequence[Axis],
    points: NDArray[np.float64],
    targets: NDArray[np.float64],
    rng: np.random.Generator,
    resamples: int,
) -> dict:
    r2 = cross_validated_r2(axes, points, targets, seed=int(rng.integers(2**31)))
    best = max(_BEST_SHARE, min(_FEWEST_BEST / len(targets), 0.5))
    f_anova = _assess(_f_anova, axes, points, targets, rng, resamples)
    ped_anova = _assess(partial(_ped_anova, best_share=best), axes, points, targets, rng, resamples)
    if r2 <= 0:
        for judged in f_anova["parameters"].values():
            judged["above_noise"] = False
    return {
        "trials": len(targets),
        "surrogate_r2": r2,
        "f_anova": {"trees": _TREES} | f_anova,
        "ped_anova": {"target_quantile": best, "region_quantile": 1.0, "evaluate_on_local": True} | ped_anova,
    }


def _assess(
    method: Method,
    axes: Sequence[Axis],
    points: NDArray[np.float64],
    targets: NDArray[np.float64],
    rng: np.random.Generator,
    resamples: int,
) -> dict:
    """Importances from all trials, and their percentiles over resampled trials, each time with another dummy."""
    resampled = []
    for _ in range(resamples):
        drawn = rng.integers(len(targets), size=len(targets))
        with_dummy = np.column_stack([points, _dummy(len(targets), rng)])
        resampled.append(method([*axes, _DUMMY], with_dummy[drawn], targets[drawn], int(rng.integers(2**31))))
    low, high = np.percentile(resampled, LEVELS, axis=0)
    floor = high[-1]
    importances = method(axes, points, targets, int(rng.integers(2**31)))
    return {
        "noise_floor": float(floor),
        "parameters": {
            axis.name: {
                "importance": float(importances[number]),
                "low": float(low[number]),
                "high": float(high[number]),
                "above_noise": bool(importances[number] > floor),
            }
            for number, axis in enumerate(axes)
        },
    }


def _dummy(count: int, rng: np.random.Generator) -> NDArray[np.float64]:
    return (rng.permutation(count) + 0.5) / count


def _f_anova(
    axes: Sequence[Axis], points: NDArray[np.float64], targets: NDArray[np.float64], seed: int
) -> NDArray[np.float64]:
    """Share of variance of each axis alone; whole numbers get a cell each, as all are drawn equally often."""
    if np.ptp(targets) == 0:
        return np.zeros(len(axes))
    distributions = {}
    for axis in axes:
        low, high = axis.bounds
        half = 0.5 if axis.is_whole else 0.0
        distributions[axis.name] = _categories(axis) or FloatDistribution(low - half, high + half)
    evaluator = FanovaImportanceEvaluator(n_trees=_TREES, max_depth=64, seed=seed)
    return _evaluate(evaluator, distributions, points, targets)


def _ped_anova(
    axes: Sequence[Axis], points: NDArray[np.float64], targets: NDArray[np.float64], _seed: int, *, best_share: float
) -> NDArray[np.float64]:
    """Divergence of the best trials' distribution from all trials', by axis, as shares of the sum."""
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
