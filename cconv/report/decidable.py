"""What the number of trials can decide about hyperparameters, and what they did decide, in sentences."""

import math
from collections.abc import Iterator, Mapping

_AT_MOST = 100 - 1  # per cent; a share is below all of it


def decidable(summary: Mapping) -> list[str]:
    """Sentences to be read before the chart of importances, one a rung; none for a run that measured no importance."""
    return [_sentence(entry) for entry in summary.get("importance", [])]


def _sentence(entry: Mapping) -> str:
    after = f"After {entry['updates']:,} updates"
    if entry["why_none"]:
        return f"{after} no importance is given: {entry['why_none']}."
    percent = min(math.ceil(100 * entry["detectable_share"]), _AT_MOST)
    return (
        f"{after}: with {entry['trials']} trials and {len(entry['parameters'])} hyperparameters, only a hyperparameter "
        f"that decides at least {percent} % of the variance is found four times in five; weaker ones are not shown to "
        f"be absent. Found: {', '.join(_found(entry)) or 'none'}."
    )


def _found(entry: Mapping) -> Iterator[str]:
    decided = [(name, each) for name, each in entry["parameters"].items() if each["decided"]]
    for name, each in sorted(decided, key=lambda item: -item[1]["share"]):
        low, high = (f"{100 * each[end]:.0f}" for end in ("low", "high"))
        yield f"{name} ({100 * each['share']:.0f} %, 95 % interval {low} to {high} %)"
