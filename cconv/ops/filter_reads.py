"""Interpolation stencils: the cells of the filter grid that each edge reads, and their weights."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import torch
from torch import Tensor

from cconv.batching import joined_indices, joined_splits
from cconv.ops import gathers


@dataclass(frozen=True, kw_only=True, eq=False)
class FilterReads:
    """Multilinear reads of a filter grid, one for each edge, in compressed rows by receiver.

    Edge e reads the 2^A cells ``cells[e] + corner_offsets[p]``. Corner p weighs ``weights[e]`` times, for each of the A
    axes a, ``fractions[e, a]`` where bit a of p is set and ``1 - fractions[e, a]`` where it is not. A is the number of
    space dimensions, or 0 where an edge reads a single cell.

    Attributes:
        row_splits: Edges of receiver i stand at ``row_splits[i]:row_splits[i + 1]``, (N + 1,), int64.
        receivers: Receiver i of each edge, (E,), int64, ascending.
        senders: Sender j of each edge, (E,), int64.
        cells: Lowest cell that each edge reads, (E,), int32.
        fractions: Position between the cells, (E, A), in [0, 1].
        weights: Window, border and 1/ψ of each edge, (E,).
        corner_offsets: Of the 2^A cells.
        num_cells: Cells of the grid, K^D.
        num_senders: Number of points that can be senders, M.
    """

    row_splits: Tensor
    receivers: Tensor
    senders: Tensor
    cells: Tensor
    fractions: Tensor
    weights: Tensor
    corner_offsets: tuple[int, ...]
    num_cells: int
    num_senders: int

    @property
    def num_receivers(self) -> int:
        """Number of receiving points N."""
        return self.row_splits.shape[0] - 1

    @property
    def num_corners(self) -> int:
        """Cells that an edge reads."""
        return len(self.corner_offsets)

    @property
    def requires_grad(self) -> bool:
        """Whether positions are differentiated."""
        return self.weights.requires_grad or self.fractions.requires_grad

    @property
    def nbytes(self) -> int:
        """Memory in bytes, the order by sender included."""
        tensors = (self.row_splits, self.receivers, self.senders, self.cells, self.fractions, self.weights)
        return sum(tensor.nbytes for tensor in tensors) + 4 * len(self.senders) + 8 * (self.num_senders + 1)

    @cached_property
    def by_sender(self) -> tuple[Tensor, Tensor]:
        """Edges in compressed rows by sender, on the CPU: splits (M + 1,), int64, and edges in that order, int32."""
        splits, order = gathers.sort_by_sender(self.senders.numpy(), self.num_senders)
        return torch.from_numpy(splits), torch.from_numpy(order)

    def corners(self) -> Iterator[tuple[Tensor, Tensor]]:
        """Cell (E,), int64, and weight (E,) of each corner in turn."""
        return corners(self.cells, self.fractions, self.weights, self.corner_offsets)

    def with_weights(self, fractions: Tensor, weights: Tensor) -> "FilterReads":
        """The same cells read with other fractions (E, A) and weights (E,)."""
        return replace(self, fractions=fractions, weights=weights)


def corners(
    cells: Tensor, fractions: Tensor, weights: Tensor, corner_offsets: Sequence[int]
) -> Iterator[tuple[Tensor, Tensor]]:
    """Cell (E,), int64, and weight (E,) of each corner that edges read; arguments as of `FilterReads`."""
    for corner, offset in enumerate(corner_offsets):
        weight = weights
        for axis, fraction in enumerate(fractions.unbind(1)):
            weight = weight * (fraction if corner >> axis & 1 else 1 - fraction)
        yield cells.long() + offset, weight


def join_reads(parts: Sequence[FilterReads]) -> FilterReads:
    """Reads of several windows in one graph, whose points stand one window after another; all read the same grid."""
    return replace(
        parts[0],
        row_splits=joined_splits([part.row_splits for part in parts]),
        receivers=joined_indices([part.receivers for part in parts], [part.num_receivers for part in parts]),
        senders=joined_indices([part.senders for part in parts], [part.num_senders for part in parts]),
        cells=torch.cat([part.cells for part in parts]),
        fractions=torch.cat([part.fractions for part in parts]),
        weights=torch.cat([part.weights for part in parts]),
        num_senders=sum(part.num_senders for part in parts),
    )
