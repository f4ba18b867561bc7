"""Splits by trajectory, or by consecutive blocks of time; never by random frame."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from cconv.data.source import SPLITS
from cconv.errors import ConfigError, DataError


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


def split_names(
    names: Sequence[str],
    num_frames: Callable[[str], int],
    fractions: Sequence[float],
    gap: int,
    seed: int,
    folder: Path,
) -> list[tuple[Block, ...]]:
    """Whole trajectories where there are enough of them; a single one is cut in time.

    Args:
        names: Names of the trajectories.
        num_frames: Number of frames of the one with a name.
        fractions: Shares of the splits.
        gap: Frames dropped between blocks of a single trajectory.
        seed: Seed of the permutation of trajectories.
        folder: Folder of the data, for messages.

    Raises:
        DataError: If there are too few trajectories, or too few frames of a single one.
    """
    if len(names) == 1:
        frames, needed = num_frames(names[0]), len(fractions) + gap * (len(fractions) - 1)
        if frames < needed:
            raise DataError(
                f"{folder}: trajectory {names[0]} has {frames} frame{'s' * (frames != 1)}, too few to cut into "
                f"{len(fractions)} blocks with a gap of {gap}; at least {needed} are needed: add frames or lower the "
                "gap."
            )
        return split_in_time(names[0], frames, fractions, gap)
    if len(names) < len(fractions):
        raise DataError(
            f"{folder}: has {len(names)} trajectories, too few for {len(fractions)} splits; "
            "add trajectories, or open a folder with a single one to have it cut in time."
        )
    return split_by_trajectory(names, fractions, seed)


def checked_fractions(fractions: Sequence[float], gap: int) -> tuple[float, ...]:
    """Shares of the three splits, as they are.

    Raises:
        ConfigError: If they are not three positive numbers that sum to 1, or the gap is negative.
    """
    fractions = tuple(float(fraction) for fraction in fractions)
    if len(fractions) != len(SPLITS) or not all(fraction > 0 for fraction in fractions):
        raise ConfigError(f"`split_fractions` must be three positive shares (train, valid, test), got {fractions}.")
    if abs(sum(fractions) - 1) > 1e-6:
        raise ConfigError(f"`split_fractions` must sum to 1, got {fractions}, which sum to {sum(fractions):g}.")
    if gap < 0:
        raise ConfigError(f"`gap` must be at least 0, got {gap}.")
    return fractions
