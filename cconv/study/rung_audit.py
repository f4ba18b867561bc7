"""Whether the order of trials at a rung foretells their order at the full budget, from trials that nothing stopped."""

import math
from collections.abc import Mapping, Sequence

import numpy as np
import scipy.stats

from cconv.study.records import TrialRecord

RELIABLE_CORRELATION = 0.6
RELIABLE_SURVIVAL = 2 / 3
FEWEST_TRIALS = 4
MEASURES = ("spearman", "kendall", "crossing_rate", "recall", "survival", "regret")


def audit_rungs(
    records: Sequence[TrialRecord],
    rungs: Sequence[int],
    *,
    top: float = 0.1,
    kept: float = 1 / 3,
    seed: int = 0,
    resamples: int = 1000,
) -> list[dict]:
    """How well the order of trials at a rung foretells their order at the full budget.

    The intervals are those of percentiles, with trials resampled. A trial that diverged has no error at the full budget
    and takes no part.

    Args:
        records: Trials that nothing stopped.
        rungs: Updates of the rungs below the full budget.
        top: Share of the trials that count as the best at the full budget; at least three count.
        kept: Share of the trials that goes on from a rung: ASHA's 1 / reduction factor.
        seed: Seed of the resampling.
        resamples: Bootstrap resamples.

    Returns:
        One entry a rung: "updates", "trials", "top" (how many count as best), "verdict", and for each measure of
        `rung_measures` its "value" with the 95 % interval from "low" to "high"; None below four trials.
        The verdict is "reliable" if the interval of Spearman's correlation lies above 0.6 and the survival is at least
        two thirds, "unreliable" if the correlation or the survival itself falls short of that, else "undecided", as too
        few trials were measured.
    """
    return [_audit(records, updates, top=top, kept=kept, seed=seed, resamples=resamples) for updates in rungs]


def _audit(records: Sequence[TrialRecord], updates: int, *, top: float, kept: float, seed: int, resamples: int) -> dict:
    at_rung, at_full = _errors_at_both(records, updates)
    trials = len(at_rung)
    counts = {"top": min(trials, max(3, math.ceil(top * trials))), "kept": max(1, math.ceil(kept * trials))}
    entry = {"updates": updates, "trials": trials, "top": counts["top"]}
    if trials < FEWEST_TRIALS:
        return entry | dict.fromkeys(MEASURES) | {"verdict": "undecided"}
    draws = np.random.default_rng(seed).integers(trials, size=(resamples, trials))
    resampled = [rung_measures(at_rung[rows], at_full[rows], **counts) for rows in draws]
    for name, value in rung_measures(at_rung, at_full, **counts).items():
        entry[name] = _with_interval(value, [measures[name] for measures in resampled])
    return entry | {"verdict": _verdict(entry)}


def _errors_at_both(records: Sequence[TrialRecord], updates: int) -> tuple[np.ndarray, np.ndarray]:
    completed = [record for record in records if record.outcome == "completed" and record.last]
    pairs = [(record.error_at(updates), record.last["valid_normalized_mse"]) for record in completed]
    at_rung, at_full = np.array([pair for pair in pairs if pair[0] is not None]).reshape(-1, 2).T
    return at_rung, at_full


def _with_interval(value: float | None, resampled: Sequence[float | None]) -> dict | None:
    known = [each for each in resampled if each is not None]
    if value is None or not known:
        return None
    low, high = np.percentile(known, (2.5, 97.5))
    return {"value": value, "low": float(low), "high": float(high)}


def rung_measures(at_rung: np.ndarray, at_full: np.ndarray, *, top: int, kept: int) -> dict[str, float | None]:
    """Agreement of the errors of the same trials at a rung and at the full budget.

    Args:
        at_rung: Errors at the rung, (trials,).
        at_full: Errors at the full budget, (trials,).
        top: Number of trials that count as the best.
        kept: Number of trials that go on from the rung.

    Returns:
        "spearman" and "kendall", the rank correlations, None where all errors are equal; "crossing_rate", the share of
        pairs of trials, ties aside, whose order turns; "recall", the share of the `top` at the full budget among the
        `top` at the rung; "survival", their share among the `kept`; "regret", the full error of the rung's best divided
        by the best full error.
    """
    by_rung, by_full = np.argsort(at_rung, kind="stable"), np.argsort(at_full, kind="stable")
    best = by_full[:top]
    ordered = np.ptp(at_rung) > 0 and np.ptp(at_full) > 0
    smallest = at_full[by_full[0]]
    return {
        "spearman": float(scipy.stats.spearmanr(at_rung, at_full).statistic) if ordered else None,
        "kendall": float(scipy.stats.kendalltau(at_rung, at_full).statistic) if ordered else None,
        "crossing_rate": _crossing_rate(at_rung, at_full),
        "recall": float(np.isin(best, by_rung[:top]).mean()),
        "survival": float(np.isin(best, by_rung[:kept]).sum() / min(top, kept)),
        "regret": float(at_full[by_rung[0]] / smallest) if smallest > 0 else None,
    }


def _crossing_rate(at_rung: np.ndarray, at_full: np.ndarray) -> float | None:
    turns = np.sign(at_rung[:, None] - at_rung) * np.sign(at_full[:, None] - at_full)
    ordered = np.count_nonzero(turns)
    return float(np.count_nonzero(turns < 0) / ordered) if ordered else None


def _verdict(entry: Mapping) -> str:
    correlation = entry["spearman"]
    if correlation is None or correlation["value"] < RELIABLE_CORRELATION:
        return "unreliable"
    if entry["survival"]["value"] < RELIABLE_SURVIVAL:
        return "unreliable"
    return "reliable" if correlation["low"] >= RELIABLE_CORRELATION else "undecided"
