"""Batches: the particles of several windows, one window after another, without padding.

A batch index (N,) tells of each particle which window it belongs to, 0 for the first. It ascends, so that the particles
of a window stand together. Where there is none, all particles are of one window.
"""

from collections.abc import Hashable, Sequence
from itertools import accumulate

import torch
from jaxtyping import Float, Int, Num
from torch import Tensor

from cconv.devices import CPU
from cconv.errors import ShapeError

# Particles of a graph of several windows at most. Joining saves a constant time for each window after the first: half
# of all for 100 particles, a tenth for 1,000, nothing for 2,500 (docs/performance.md).
MOST_JOINED = 4096


def index_of(counts: Sequence[int], device: torch.device = CPU) -> Int[Tensor, " N"]:
    """Batch index (N,) of windows with so many particles each, on a device."""
    repeats = torch.tensor(counts, dtype=torch.int64, device=device)
    return torch.arange(len(counts), device=device).repeat_interleave(repeats, output_size=sum(counts))


def counts_of(batch_index: Int[Tensor, " N"], windows: int = 0) -> list[int]:
    """Numbers of particles of each window.

    Args:
        batch_index: Window of each particle (N,).
        windows: Least number of windows, if the last ones may have no particles.
    """
    return torch.bincount(batch_index, minlength=windows).tolist()


def joined_indices(parts: Sequence[Int[Tensor, " E_part"]], counts: Sequence[int]) -> Int[Tensor, " E"]:
    """Indices of the points of several windows, of which each has so many, once they stand one after another."""
    return torch.cat([part + first for part, first in zip(parts, accumulate(counts, initial=0), strict=False)])


def joined_splits(parts: Sequence[Int[Tensor, " splits"]]) -> Int[Tensor, " all_splits"]:
    """Row splits of the rows of several windows one after another, from the splits of each, which begin with 0."""
    lengths = (int(part[-1]) for part in parts)
    rows = [part[1:] + first for part, first in zip(parts, accumulate(lengths, initial=0), strict=False)]
    return torch.cat([parts[0][:1], *rows])


def check_batch_index(name: str, batch_index: Tensor, points: int) -> None:
    """Require a batch index of so many points.

    Raises:
        ShapeError: If it has another shape, is no whole number, or does not ascend from 0.
    """
    if batch_index.shape != (points,) or batch_index.dtype != torch.int64:
        raise ShapeError(f"`{name}` must be int64 of shape ({points},), got {batch_index.dtype} {batch_index.shape}.")
    if points and (int(batch_index[0]) < 0 or bool((batch_index.diff() < 0).any())):
        raise ShapeError(f"`{name}` must ascend from 0, so that the particles of a window stand together.")


def means_of_windows(values: Float[Tensor, "N C"], batch_index: Int[Tensor, " N"] | None) -> Float[Tensor, "..."]:
    """Mean of values (N, C) over the particles of each particle's window, (N, C), or (C,) if there is one window."""
    if batch_index is None:
        return values.mean(dim=0)
    counts = torch.bincount(batch_index).clamp(min=1).to(values.dtype)
    sums = values.new_zeros(len(counts), values.shape[1]).index_add(0, batch_index, values)
    return (sums / counts[:, None])[batch_index]


def largest_of_windows(values: Num[Tensor, " N"], batch_index: Int[Tensor, " N"], windows: int) -> list:
    """Largest of the values (N,), none of them negative, in each of so many windows; 0 in one without particles."""
    return values.new_zeros(windows).scatter_reduce(0, batch_index, values, "amax").tolist()


def groups_of(counts: Sequence[int], kinds: Sequence[Hashable], most: int = MOST_JOINED) -> list[list[int]]:
    """Windows to join: those of the same kind, in their order, as long as they have at most so many particles together.

    Args:
        counts: Particles of each window.
        kinds: Kind of each window; windows of different kinds are not joined.
        most: Largest number of particles of a group of several windows.

    Returns:
        Numbers of the windows of each group.
    """
    groups: list[list[int]] = []
    open_groups: dict[Hashable, tuple[list[int], int]] = {}
    for number, (count, kind) in enumerate(zip(counts, kinds, strict=True)):
        group, together = open_groups.get(kind, ([], 0))
        if not group or together + count > most:
            group, together = [], 0
            groups.append(group)
        group.append(number)
        open_groups[kind] = group, together + count
    return groups
