"""Cost and result of a search, and of other stopping rules replayed on trials without early stopping."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from cconv.study.records.found import ReplayedStrategy, SpentUpdates
from cconv.study.records.rungs import RungTable
from cconv.study.records.trials import TrialRecord

Curve = Sequence[tuple[int, float]]


@dataclass(frozen=True, kw_only=True)
class Replay:
    """Outcome of a stopping rule.

    Attributes:
        updates: Gradient updates spent on all trials.
        best_error: Smallest error at the full budget among the trials that reached it.
    """

    updates: int
    best_error: float


def spent_updates(records: Sequence[TrialRecord], full_updates: int) -> SpentUpdates:
    """Count the updates of one or more trials, and the updates that they would have spent without early stopping."""
    spent = sum(record.log[-1]["updates"] for record in records if record.log)
    full = len(records) * full_updates
    return SpentUpdates(updates=spent, full_updates=full, share=spent / full)


def best_so_far(records: Sequence[TrialRecord]) -> list[tuple[int, float]]:
    """List (cumulative updates, smallest error of a completed trial) after each trial, from the first completed one on.

    Args:
        records: Trials in the order in which they were drawn; trials that ran at the same time count one after another.
    """
    curve: list[tuple[int, float]] = []
    spent, best = 0, float("inf")
    for record in records:
        spent += record.log[-1]["updates"] if record.log else 0
        if (error := record.final_error) is not None:
            best = min(best, error)
        if best < float("inf"):
            curve.append((spent, best))
    return curve


def learning_curves(records: Sequence[TrialRecord]) -> dict[str, list[tuple[int, float]]]:
    """List (updates, validation error) of each evaluation by the id of every completed trial with finite errors."""
    curves = {
        record.id: [(entry["updates"], entry["valid_error"]) for entry in record.log]
        for record in records
        if record.outcome == "completed" and record.log
    }
    return {trial: curve for trial, curve in curves.items() if all(error is not None for _, error in curve)}


def replay_asha(
    curves: Mapping[str, Curve], rungs: Sequence[int], reduction_factor: int, order: Sequence[str]
) -> Replay:
    """Replay ASHA with one worker, which takes the trials in a given order.

    Args:
        curves: Learning curves up to the full budget, by trial; the rungs are among their evaluations.
        rungs: Updates of the rungs; the last one is the full budget.
        reduction_factor: A trial continues if it is within the best 1 / `reduction_factor` of those before it.
        order: Names of the trials; a repeated name is another trial.
    """
    table = RungTable(rungs, reduction_factor)
    spent, finished = 0, []
    for number, trial in enumerate(order):
        curve = curves[trial]
        stop = next((updates for updates, error in curve if not table.record(f"{number}", updates, error)), None)
        spent += curve[-1][0] if stop is None else stop
        if stop is None:
            finished.append(curve[-1][1])
    return Replay(updates=spent, best_error=min(finished))


def replay_little_each(curves: Mapping[str, Curve], updates_each: int, keep: int, trials: Sequence[str] = ()) -> Replay:
    """Replay the rule that trains every trial a little, then the best few to the full budget.

    Source: Egele et al., "The unreasonable effectiveness of early discarding after one epoch in neural network
    hyperparameter optimization", Neurocomputing (2024).

    Args:
        curves: Learning curves up to the full budget, by trial.
        updates_each: Updates after which trials are compared, an evaluation of every curve.
        keep: Number of trials that continue.
        trials: Names of the trials, which may be repeated; by default each once.
    """
    chosen = [curves[trial] for trial in trials or curves]
    ranked = sorted(chosen, key=lambda curve: dict(curve)[updates_each])
    spent = sum(curve[-1][0] if place < keep else updates_each for place, curve in enumerate(ranked))
    return Replay(updates=spent, best_error=min(curve[-1][1] for curve in ranked[:keep]))


def compare_strategies(
    curves: Mapping[str, Curve], rungs: Sequence[int], reduction_factor: int, *, draws: int = 200, seed: int = 0
) -> list[ReplayedStrategy]:
    """Replay ASHA, training all trials a little and the best to the end, and no stopping, on trials that are redrawn.

    Each draw takes as many trials as there are, with replacement and in random order, so that the range includes the
    variance of the order and of the configurations. The second rule is replayed for each rung below the full budget; it
    keeps as many trials as the mean updates of ASHA pay for, at least one.

    Args:
        curves: Learning curves up to the full budget, by trial.
        rungs: Updates of the rungs; the last one is the full budget.
        reduction_factor: Reduction factor of ASHA.
        draws: Number of draws.
        seed: Seed of the draws.

    Returns:
        One entry a rule; the share is the mean over the draws, and the range is from the 2.5th to the 97.5th
        percentile. Only curves that were measured at every rung count; without one the list is empty.
    """
    curves = {trial: curve for trial, curve in curves.items() if set(rungs) <= set(dict(curve))}
    if not curves:
        return []
    rng, names = np.random.default_rng(seed), list(curves)
    samples = [[names[index] for index in rng.integers(len(names), size=len(names))] for _ in range(draws)]
    asha = [replay_asha(curves, rungs, reduction_factor, sample) for sample in samples]
    mean_spent, entries = np.mean([replay.updates for replay in asha]), []
    for updates in rungs[:-1]:
        keep = max(1, int((mean_spent - len(names) * updates) / (rungs[-1] - updates)))
        replays = [replay_little_each(curves, updates, keep, sample) for sample in samples]
        entries.append(_strategy("little_each", curves, samples, replays, updates_each=updates, keep=keep))
    everything = [replay_little_each(curves, rungs[-1], len(names), sample) for sample in samples]
    return [
        _strategy("asha", curves, samples, asha),
        *entries,
        _strategy("no_stopping", curves, samples, everything),
    ]


def _strategy(
    name: str,
    curves: Mapping[str, Curve],
    samples: Sequence[Sequence[str]],
    replays: Sequence[Replay],
    updates_each: int | None = None,
    keep: int | None = None,
) -> ReplayedStrategy:
    shares, regrets = [], []
    for sample, replay in zip(samples, replays, strict=True):
        chosen = [curves[trial] for trial in sample]
        shares.append(replay.updates / sum(curve[-1][0] for curve in chosen))
        regrets.append(replay.best_error / min(curve[-1][1] for curve in chosen))
    return ReplayedStrategy(
        strategy=name,
        updates_each=updates_each,
        keep=keep,
        share=float(np.mean(shares)),
        regret=float(np.exp(np.mean(np.log(regrets)))),
        regret_range95=np.percentile(regrets, (2.5, 97.5)).tolist(),
    )
