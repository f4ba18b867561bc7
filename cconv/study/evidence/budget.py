"""The influence of the training budget: whether the error still fell at the end, and what larger budgets gain."""

from collections.abc import Mapping, Sequence

import numpy as np

from cconv.study.records.found import BudgetPoint, Convergence
from cconv.study.records.summary import FinalistEntry
from cconv.study.records.trials import TrialRecord

LAST_PART = 0.25  # of the updates of a training


def still_falling(points: Sequence[BudgetPoint], margin: float) -> bool:
    """Tell whether the last budget lowered the validation error of the one before it by more than a share of it.

    Args:
        points: Trainings with ascending budgets; the answer is True if there is only one.
        margin: The share.
    """
    if len(points) < 2:
        return True
    before, last = (point.valid_error for point in points[-2:])
    return last < (1 - margin) * before


def fall_at_the_end(records: Sequence[TrialRecord]) -> float | None:
    """Return the share by which the best validation error fell in the last quarter of the updates, mean over seeds.

    It is None if no error was measured before that quarter, as for models that are fitted and not trained.
    """
    falls = []
    for record in records:
        errors = [(entry["updates"], entry["valid_error"]) for entry in record.log]
        begin = (1 - LAST_PART) * errors[-1][0] if errors else 0
        before = [error for updates, error in errors if updates <= begin and error is not None]
        if begin and before and min(before) > 0:
            falls.append(1 - record.best / min(before))
    return float(np.mean(falls)) if falls else None


def budget_words(finalists: Sequence[FinalistEntry], convergence: Mapping[str, Convergence], margin: float) -> str:
    """Describe in sentences whose error the budget limits; "" if no model gains from more updates.

    Args:
        finalists: The finalists.
        convergence: Errors with larger budgets, by model.
        margin: Share of the error; a smaller gain is ignored.
    """
    sentences = [_gain(name, found) for name, found in convergence.items() if len(found.points) > 1]
    longer = {point.id for found in convergence.values() for point in found.points}
    falling = [
        f"{entry.id} (by {entry.fall_at_the_end:.0%} in the last quarter of its {entry.updates:,} updates)"
        for entry in finalists
        if entry.id not in longer and (entry.fall_at_the_end or 0) > margin
    ]
    if falling:
        sentences.append(
            f"The budget limits the error of {', '.join(falling)}: it was still falling when the training ended."
        )
    return " ".join(sentences)


def _gain(name: str, found: Convergence) -> str:
    first, last = found.points[0], found.points[-1]
    end = "and it was still falling" if found.still_falling else "and more updates do not lower it"
    return (
        f"The budget of {first.updates:,} updates limits the validation error of {name} to {first.valid_error:.3g}: "
        f"after {last.updates:,} updates it is {last.valid_error:.3g}, {end}."
    )
