"""Neighbours of moving particles, searched anew only once these have moved, and loops over them on several threads."""

from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from torch import Tensor

from cconv.domain import Box
from cconv.errors import ConfigError
from cconv.neighbors import half_list
from cconv.ops.workers import run_on_workers
from cconv.sph import pair_loops

_PAIRS_PER_WORKER = 20_000  # fewer cost less than waking a thread


class Rows:
    """Neighbours in compressed rows, shared out among threads by their number."""

    def __init__(self, splits: np.ndarray, neighbors: np.ndarray):
        self._lists = (splits, neighbors)
        workers = max(1, min(torch.get_num_threads(), len(neighbors) // _PAIRS_PER_WORKER))
        inner = np.searchsorted(splits, np.linspace(0, len(neighbors), workers + 1)[1:-1])
        self._bounds = [0, *inner.tolist(), len(splits) - 1]

    def visit(self, loop: Callable, *arguments: Any) -> None:
        """Run a loop of `pair_loops` over all rows."""
        bounds = self._bounds
        run_on_workers(
            lambda worker: loop(bounds[worker], bounds[worker + 1], *self._lists, *arguments), len(bounds) - 1
        )


class NeighborList:
    """Neighbours within reach + skin, searched anew once a particle has moved by half of the skin.

    Args:
        box: Domain with its periodic axes.
        reach: Distance within which every pair must be listed.
        skin: Extra distance.

    Raises:
        ConfigError: If a periodic axis is too short for a pair to have one nearest image.
    """

    def __init__(self, box: Box, reach: float, skin: float):
        check_wide_enough(box, reach + skin)
        self._box, self._reach, self._skin = box, reach, skin
        self._lengths = periodic_lengths(box)
        self._searched_at, self._walls_then = np.empty((0, 3)), np.empty(0, bool)
        self._found = Rows(np.zeros(1, np.int64), np.empty(0, np.int32))

    def rows(self, positions: np.ndarray, is_wall: np.ndarray) -> Rows:
        """Rows of all pairs with a fluid particle, of positions (N, 3) and which of them are walls (N,)."""
        holds = np.array_equal(is_wall, self._walls_then) and not pair_loops.moved_further(
            positions, self._searched_at, self._lengths, 0.5 * self._skin
        )
        if not holds:
            points = torch.from_numpy(positions[:, : self._box.dim])
            pairs = half_list(points, self._reach + self._skin, self._box)
            self._found = Rows(*pair_loops.rows_of_pairs(pairs, is_wall))
            self._searched_at, self._walls_then = positions, is_wall.copy()
        return self._found


def periodic_lengths(box: Box) -> np.ndarray:
    """Lengths of the periodic axes (3,), infinite for others."""
    lengths = np.full(3, np.inf)
    lengths[: box.dim] = np.where(box.periodic, box.lengths, np.inf)
    return lengths


def padded(vectors: Tensor) -> np.ndarray:
    """Vectors (N, D) in float64 with three components, the further ones zero, as `pair_loops` take them."""
    array = np.zeros((len(vectors), 3))
    array[:, : vectors.shape[1]] = vectors.numpy()
    return array


def unpadded(vectors: np.ndarray, dim: int) -> Tensor:
    """The first components of vectors (N, 3), a tensor (N, D) of its own."""
    return torch.from_numpy(vectors[:, :dim].copy())


def moved(positions: np.ndarray, velocities: np.ndarray, time_step: float, box: Box) -> np.ndarray:
    """Positions (N, 3) a time step later, brought back into the box along periodic axes."""
    lower, later = np.zeros(3), np.empty_like(positions)
    lower[: box.dim] = box.lower
    pair_loops.move(positions, velocities, time_step, lower, periodic_lengths(box), later)
    return later


def check_wide_enough(box: Box, reach: float) -> None:
    """Raise `ConfigError` if a periodic axis is too short for a pair within reach to have one nearest image."""
    for axis, (length, periodic) in enumerate(zip(box.lengths, box.periodic, strict=True)):
        if periodic and length < 2 * reach:
            raise ConfigError(
                f"`box` must be at least {2 * reach:.4g} long on its periodic axis {axis}, twice the reach of the "
                f"kernel and the skin, got {length:g}; take a smaller particle spacing."
            )
