"""The audit of the rungs: how well the order of trials at a rung predicts their order at the full budget."""

import math
from collections.abc import Sequence

import numpy as np
import scipy.stats

from cconv.study.records.found import RungAudit
from cconv.study.records.trials import TrialRecord

RELIABLE_CORRELATION = 0.6
RELIABLE_SURVIVAL = 2 / 3
FEWEST_TRIALS = 4
FEWEST_FOR_INTERVAL = 12
_QUANTILE = 1.959964  # of the normal distribution
MEASURES = ("spearman", "kendall", "crossing_rate", "recall", "survival", "regret")


def audit_rungs(
    records: Sequence[TrialRecord], rungs: Sequence[int], *, top: float = 0.1, kept: float = 1 / 3
) -> list[RungAudit]:
    """Measure how well the order of trials at each rung predicts their order at the full budget.

    A trial that diverged has no error at the full budget and is left out.

    Args:
        records: Trials without early stopping.
        rungs: Updates of the rungs below the full budget.
        top: Share of the trials that count as the best at the full budget; at least three count.
        kept: Share of the trials that continue beyond a rung: ASHA's 1 / reduction factor.

    Returns:
        One entry a rung, with the measures of `rung_measures`, None below four trials, and the 95 % interval of
        Spearman's correlation. The verdict is "undecided" without an interval. It is "unreliable" if the correlation is
        below 0.6 or the survival below two thirds, "reliable" if the whole interval lies above 0.6, and else
        "undecided". The other measures have no interval, because none that was tried covers the true value often
        enough.
    """
    return [_audit(records, updates, top=top, kept=kept) for updates in rungs]


def _audit(records: Sequence[TrialRecord], updates: int, *, top: float, kept: float) -> RungAudit:
    at_rung, at_full = _errors_at_both(records, updates)
    trials = len(at_rung)
    counts = {"top": min(trials, max(3, math.ceil(top * trials))), "kept": max(1, math.ceil(kept * trials))}
    measures: dict[str, float | None] = dict.fromkeys(MEASURES)
    if trials >= FEWEST_TRIALS:
        measures = rung_measures(at_rung, at_full, **counts)
    correlation, survival = measures["spearman"], measures["survival"]
    interval = None if correlation is None else spearman_interval(correlation, trials)
    return RungAudit(
        updates=updates,
        trials=trials,
        top=counts["top"],
        **measures,
        spearman_ci95=interval,
        why_no_interval="" if interval else _why_no_interval(trials),
        verdict=_verdict(correlation, survival, interval),
    )


def _why_no_interval(trials: int) -> str:
    if trials < FEWEST_FOR_INTERVAL:
        return f"{trials} trials, and at least {FEWEST_FOR_INTERVAL} are needed"
    return "all errors are equal"


def spearman_interval(correlation: float, trials: int) -> list[float] | None:
    r"""Compute the 95 % interval of Spearman's correlation; None below twelve trials, too few for a verdict.

    It is Fisher's z plus and minus 1.96 standard errors :math:`\sqrt{(1 + r^2 / 2) / (n - 3)}`. A correlation of 1
    is lowered by half of what a swap of two neighbours would lower it, so that it has an interval too. Source: Bonett
    and Wright, "Sample size requirements for estimating Pearson, Kendall and Spearman correlations", Psychometrika 65
    (2000).
    """
    if trials < FEWEST_FOR_INTERVAL:
        return None
    nearly_one = 1 - 6 / (trials**3 - trials)
    center = math.atanh(min(max(correlation, -nearly_one), nearly_one))
    width = _QUANTILE * math.sqrt((1 + correlation**2 / 2) / (trials - 3))
    return [min(math.tanh(center - width), correlation), max(math.tanh(center + width), correlation)]


def _errors_at_both(records: Sequence[TrialRecord], updates: int) -> tuple[np.ndarray, np.ndarray]:
    pairs = [(record.error_at(updates), record.final_error) for record in records]
    at_rung, at_full = np.array([pair for pair in pairs if None not in pair]).reshape(-1, 2).T
    return at_rung, at_full


def rung_measures(at_rung: np.ndarray, at_full: np.ndarray, *, top: int, kept: int) -> dict[str, float | None]:
    """Measure how well the errors of the same trials at a rung and at the full budget agree.

    Args:
        at_rung: Errors at the rung, (trials,).
        at_full: Errors at the full budget, (trials,).
        top: Number of trials that count as the best.
        kept: Number of trials that continue beyond the rung.

    Returns:
        "spearman" and "kendall", the rank correlations, None where all errors are equal; "crossing_rate", the share of
        pairs of trials without a tie whose order changes; "recall", the share of the `top` at the full budget that are
        among the `top` at the rung; "survival", the share that are among the `kept`; "regret", the error at the full
        budget of the best trial at the rung, divided by the smallest error at the full budget.
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


def _verdict(correlation: float | None, survival: float | None, interval: Sequence[float] | None) -> str:
    if correlation is None or survival is None or interval is None:
        return "undecided"
    if correlation < RELIABLE_CORRELATION or survival < RELIABLE_SURVIVAL:
        return "unreliable"
    return "reliable" if interval[0] >= RELIABLE_CORRELATION else "undecided"
