"""The reference stage compares ASHA with another stopping rule at the same budget.

The other rule is early discarding after one rung: every trial is trained to the first rung, and only the best of them
to the full budget, as many as the updates that ASHA spent would pay for.
"""

import math
from collections.abc import Sequence
from typing import Literal

from cconv.study.declared.stage import Stage, reads_of
from cconv.study.evidence.strategies import best_so_far, spent_updates
from cconv.study.records.found import Found, References, SearchStrategy
from cconv.study.records.trials import TrialRecord
from cconv.study.stages.jobs import train_all, trial_job
from cconv.study.stages.session import Session


class ReferenceStage(Stage):
    """Compare each search with the rule that trains all trials to the first rung and the best to the full budget."""

    kind: Literal["reference"] = "reference"
    is_single = True
    uses = ("random", "adaptive")
    needs_records = True

    def run(self, session: Session, name: str) -> Found:
        """Train the trials that ASHA stopped but the other rule keeps, and compare both rules at the same budget.

        Every trial of a search was measured at the first rung. The updates that the search spent beyond it pay for the
        full training of the trials that are best there. Those of them that ASHA stopped are trained again.
        """
        study, run = session.study, session.run
        read = {search: run.trials_of(search) for search in reads_of(study.stages, name)}
        searches = {search: records for search, records in read.items() if records}
        kept = {search: kept_at_same_budget(records, study.rungs) for search, records in searches.items()}
        trained = _train_stopped(session, name, [record for records in kept.values() for record in records])
        strategies, shares = {}, {}
        for search, records in searches.items():
            finals = [trained.get(record.id, record) for record in kept[search]]
            strategies[f"{search}, ASHA"] = _by_asha(records)
            strategies[f"{search}, a little each"] = _by_first_rung(finals, len(records), study.rungs)
            shares[search] = spent_updates(records, study.training.updates)
        return Found(references=References(strategies=strategies, asha_share=shares))


def kept_at_same_budget(records: Sequence[TrialRecord], rungs: Sequence[int]) -> list[TrialRecord]:
    """Choose the trials that are best at the first rung: as many as the search could have trained to the end.

    Args:
        records: All trials of the search, at least one.
        rungs: Updates of its rungs; the last one is the full budget.

    Returns:
        At least one of the trials that reached the first rung, if there is any, in the order of `records`.
    """
    first, full = rungs[0], rungs[-1]
    spent = spent_updates(records, full).updates
    count = max(1, int((spent - len(records) * first) // max(full - first, 1)))
    at_first = {record.id: error for record in records if (error := record.error_at(first)) is not None}
    best = sorted(at_first, key=at_first.__getitem__)[:count]
    return [record for record in records if record.id in best]


def _train_stopped(session: Session, stage: str, kept: Sequence[TrialRecord]) -> dict[str, TrialRecord]:
    """Train the kept trials that ASHA stopped to the full budget; return their new records by the ids of the trials."""
    stopped = [record for record in kept if record.outcome == "stopped"]
    jobs = [trial_job(session, stage, number, record.parameters) for number, record in enumerate(stopped)]
    train_all(session, stage, jobs, session.study.training)
    ids = {job.name: record.id for job, record in zip(jobs, stopped, strict=True)}
    return {ids[record.id]: record for record in session.run.trials_of(stage) if record.id in ids}


def _by_asha(records: Sequence[TrialRecord]) -> SearchStrategy:
    """Summarise what the search itself spent and found."""
    curve = best_so_far(records)
    return SearchStrategy(
        updates=sum(record.log[-1]["updates"] for record in records if record.log),
        best_valid=curve[-1][1] if curve else None,
        curve=curve,
    )


def _by_first_rung(finals: Sequence[TrialRecord], num_trials: int, rungs: Sequence[int]) -> SearchStrategy:
    """Summarise what the other rule spends and finds; `finals` are the trials that it trains to the full budget."""
    spent, best, curve = num_trials * rungs[0], math.inf, []
    for record in finals:
        spent += rungs[-1] - rungs[0]
        if (error := record.final_error) is not None:
            best = min(best, error)
            curve.append((spent, best))
    return SearchStrategy(updates=spent, best_valid=best if curve else None, curve=curve)
