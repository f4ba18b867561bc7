"""What the budget of a training decided: whether its error was still falling, and what larger budgets brought."""

from collections.abc import Mapping, Sequence

import numpy as np

from cconv.study.records.found import BudgetPoint, Convergence
from cconv.study.records.summary import FinalistEntry
from cconv.study.records.trials import TrialRecord

LAST_PART = 0.25  # of the updates of a training


def still_falling(points: Sequence[BudgetPoint], margin: float) -> bool:
    """Whether the last budget lowered the validation error of the one before it by more than `margin`, a share.

    Args:
        points: Trainings with ascending budgets; a single one says nothing, so True.
        margin: Share of the error.
    """
    if len(points) < 2:
        return True
    before, last = (point.valid_error for point in points[-2:])
    return last < (1 - margin) * before


def fall_at_the_end(records: Sequence[TrialRecord]) -> float | None:
    """Share by which the best validation error of trainings fell in the last quarter of their updates, mean over seeds.

    None where nothing was measured before that quarter, as for models that are fitted and not trained.
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
    """What a budget decided, in sentences; "" where no model gained from a larger one or was still improving.

    Args:
        finalists: The finalists.
        convergence: What the converge stages found, by model.
        margin: Share of the error below which a gain counts as none.
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
            f"A budget decided the error of {', '.join(falling)}: it was still falling when the updates ended."
        )
    return " ".join(sentences)


def _gain(name: str, found: Convergence) -> str:
    first, last = found.points[0], found.points[-1]
    end = "and it was still falling" if found.still_falling else "and more updates bring nothing"
    return (
        f"The budget of {first.updates:,} updates decided the error of {name}, {first.valid_error:.3g}: "
        f"after {last.updates:,} updates it is {last.valid_error:.3g} (validation), {end}."
    )
