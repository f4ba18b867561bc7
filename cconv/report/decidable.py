"""What the number of trials can decide about hyperparameters, and what they did decide, in sentences."""

import math
from collections.abc import Iterator, Sequence

from cconv.study.records.found import RungImportance

_AT_MOST = 100 - 1  # per cent; a share is below all of it


def decidable(importance: Sequence[RungImportance]) -> list[str]:
    """Sentences to be read before the chart of importances, one a rung."""
    return [_sentence(entry) for entry in importance]


def _sentence(entry: RungImportance) -> str:
    after = f"After {entry.updates:,} updates"
    if entry.detectable_share is None:
        return f"{after} no importance is given: {entry.why_none}."
    percent = min(math.ceil(100 * entry.detectable_share), _AT_MOST)
    return (
        f"{after}: with {entry.trials} trials and {len(entry.parameters)} hyperparameters, only a hyperparameter "
        f"that decides at least {percent} % of the variance is found four times in five; weaker ones are not shown to "
        f"be absent. Found: {', '.join(_found(entry)) or 'none'}."
    )


def _found(entry: RungImportance) -> Iterator[str]:
    decided = [(name, each.tested) for name, each in entry.parameters.items() if each.decided and each.tested]
    for name, each in sorted(decided, key=lambda item: -item[1].share):
        interval = f"95 % interval {100 * each.low:.0f} to {100 * each.high:.0f} %"
        yield f"{name} ({100 * each.share:.0f} %, {interval})"
