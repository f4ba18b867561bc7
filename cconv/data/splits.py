"""Splits by trajectory, or by consecutive blocks of time; never by random frame."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np


class Block(NamedTuple):
    """Frames `start` to `stop` of a trajectory; to its end if `stop` is None."""

    trajectory: str
    start: int
    stop: int | None


def share_out(total: int, fractions: Sequence[float]) -> list[int]:
    """Whole numbers near the shares of `total`, at least 1 each, that sum to it; the first takes the rest."""
    others = [max(1, round(total * fraction / sum(fractions))) for fraction in fractions[1:]]
    while total - sum(others) < 1 and max(others) > 1:
        others[others.index(max(others))] -= 1
    return [total - sum(others), *others]


def evenly_spaced(total: int, count: int) -> list[int]:
    """Up to `count` different indices of `total` things, from the first to the last."""
    return np.unique(np.linspace(0, total - 1, count).round().astype(int)).tolist()


def split_by_trajectory(names: Sequence[str], fractions: Sequence[float], seed: int) -> list[tuple[Block, ...]]:
    """Whole trajectories by shares, drawn by a seeded permutation, in their own order within a split."""
    order = np.random.default_rng(seed).permutation(len(names))
    stops = np.cumsum(share_out(len(names), fractions))[:-1]
    return [tuple(Block(names[index], 0, None) for index in sorted(members)) for members in np.split(order, stops)]


def split_in_time(name: str, num_frames: int, fractions: Sequence[float], gap: int) -> list[tuple[Block, ...]]:
    """Consecutive blocks of a trajectory by shares, with `gap` frames dropped between blocks."""
    blocks: list[tuple[Block, ...]] = []
    start = 0
    for count in share_out(num_frames - gap * (len(fractions) - 1), fractions):
        blocks.append((Block(name, start, start + count),))
        start += count + gap
    return blocks
