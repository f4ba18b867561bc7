"""The choice among relaxations that were tried: the cheapest of the good ones."""

from collections.abc import Sequence

from cconv.study.records.found import TriedRelaxation

NEAR_BEST = 1.1  # a relaxation is good if its quality is at most so many times the best


def chosen_relaxation(tried: Sequence[TriedRelaxation]) -> int:
    """Number of the relaxation with the fewest loops whose quality is within 10 % of the best, the best of equal ones.

    One with a rollout that diverged is chosen only where all have one. None at all, with no loop, can be chosen too.

    Args:
        tried: At least one relaxation.
    """
    fewest = min(each.diverged for each in tried)
    possible = [number for number, each in enumerate(tried) if each.diverged == fewest]
    best = min(tried[number].quality for number in possible)
    good = [number for number in possible if tried[number].quality <= NEAR_BEST * best]
    return min(good, key=lambda number: (tried[number].loops, tried[number].quality))


def relaxation_front(tried: Sequence[TriedRelaxation]) -> list[int]:
    """Numbers of the relaxations than which no other has as few loops and as good a quality, fewest loops first."""
    front: list[int] = []
    for number in sorted(range(len(tried)), key=lambda number: (tried[number].loops, tried[number].quality)):
        if not front or tried[number].quality < tried[front[-1]].quality:
            front.append(number)
    return front
