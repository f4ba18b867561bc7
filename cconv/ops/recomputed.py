"""Convolutions in torch operations on any device, block by block of receivers, whose memory does not grow with N·K^D·C.

What the edges of a block read is a small dense product for each receiver: with the weights S (P, K^D) that its up to P
edges read the filter cells with, and their messages F (P, C), the columns of a receiver are Sᵀ F. Its products with the
filters are those of a whole block. Nothing of a block is kept: the backward pass computes it again, and derives it.
So everything can be differentiated, positions too, and each value is written once, without atomics, but for the
derivatives of features that several blocks read.
"""

from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from functools import partial
from typing import Any, TypeVar

import numpy as np
import torch
from torch import Tensor

from cconv.ops import general
from cconv.ops.filter_reads import FilterReads, corners

_BLOCK_VALUES = 2**25  # numbers that the columns of a block and what they are made of hold at most
_WIDTH = 64  # edges of a receiver that one product takes at most; those with more take several

T = TypeVar("T")
Compute = Callable[["Block", Tensor, Tensor, Sequence[Tensor], Sequence[Tensor]], Tensor]


@dataclass(frozen=True, kw_only=True)
class Block:
    """Consecutive receivers and their edges.

    Attributes:
        rows: The receivers.
        edges: The edges.
        counts: Edges of each receiver (n,), int64.
        largest: Largest number of edges of a receiver.
    """

    rows: slice
    edges: slice
    counts: Tensor
    largest: int

    @property
    def num_rows(self) -> int:
        """Number of receivers n."""
        return self.rows.stop - self.rows.start

    def columns(self, messages: Tensor, stencil: "Stencil") -> Tensor:
        """Gather messages (E, C) of the edges into the filter cells of each receiver, (n, K^D, C)."""
        row = torch.arange(self.num_rows, device=self.counts.device)
        receiver = row.repeat_interleave(self.counts, output_size=len(messages))
        place = torch.arange(len(messages), device=self.counts.device) - (self.counts.cumsum(0) - self.counts)[receiver]
        if self.largest <= _WIDTH:
            return _columns(messages, stencil, receiver * self.largest + place, (self.num_rows, self.largest))
        gathered = messages.new_zeros(self.num_rows, stencil.num_cells, messages.shape[1])
        for first in range(0, self.largest, _WIDTH):
            chosen = (place >= first) & (place < first + _WIDTH)
            some = torch.nonzero(self.counts > first)[:, 0]
            number = torch.zeros_like(row).index_put((some,), torch.arange(len(some), device=row.device))
            places = number[receiver[chosen]] * _WIDTH + place[chosen] - first
            part = _columns(messages[chosen], stencil.of(chosen), places, (len(some), _WIDTH))
            gathered = gathered.index_add(0, some, part.to(gathered.dtype))
        return gathered


@dataclass(frozen=True, kw_only=True)
class Stencil:
    """The cells of the filter grid that some edges read; attributes as of `FilterReads`."""

    cells: Tensor
    fractions: Tensor
    weights: Tensor
    corner_offsets: tuple[int, ...]
    num_cells: int

    def of(self, chosen: Tensor) -> "Stencil":
        """The same of some of the edges (E,), bool."""
        parts = {name: getattr(self, name)[chosen] for name in ("cells", "fractions", "weights")}
        return Stencil(**parts, corner_offsets=self.corner_offsets, num_cells=self.num_cells)


def stencil_of(reads: FilterReads, edges: slice, fractions: Tensor, weights: Tensor) -> Stencil:
    """What some consecutive edges read, with fractions and weights that may be differentiated."""
    return Stencil(
        cells=reads.cells[edges],
        fractions=fractions,
        weights=weights,
        corner_offsets=reads.corner_offsets,
        num_cells=reads.num_cells,
    )


def _columns(messages: Tensor, stencil: Stencil, places: Tensor, shape: tuple[int, int]) -> Tensor:
    """Columns (n, K^D, C) of n receivers with up to P edges each, whose messages stand at some places of (n, P)."""
    rows, width = shape
    read_cells = list(corners(stencil.cells, stencil.fractions, stencil.weights, stencil.corner_offsets))
    read = torch.stack([places * stencil.num_cells + cell for cell, _ in read_cells], dim=1).flatten()
    weights = torch.stack([weight for _, weight in read_cells], dim=1).flatten()
    dense = weights.new_zeros(rows * width * stencil.num_cells).scatter_add(0, read, weights)
    sent = messages.new_zeros(rows * width, messages.shape[1]).index_copy(0, places, messages)
    return torch.bmm(
        dense.view(rows, width, stencil.num_cells).transpose(1, 2), sent.view(rows, width, messages.shape[1])
    )


def applies(values: Tensor) -> bool:
    """Tell whether blocks are the path of these values: where compiled loops know device or precision of products not.

    A graph that is compiled can hold neither.
    """
    on_cpu = values.device.type == "cpu"
    return not torch.compiler.is_compiling() and (not on_cpu or torch.is_autocast_enabled("cpu"))


def convolve(features: Tensor, filters: Tensor, reads: FilterReads, own: float) -> Tensor:
    """As `general.gather_then_multiply`, with a memory that does not depend on the number of receivers."""
    num_cells, in_channels, out_channels = filters.shape

    def compute(
        block: Block, sent: Tensor, received: Tensor, per_edge: Sequence[Tensor], shared: Sequence[Tensor]
    ) -> Tensor:
        messages = sent + own * received.repeat_interleave(block.counts, 0, output_size=len(sent)) if own else sent
        columns = block.columns(messages, stencil_of(reads, block.edges, *per_edge))
        return columns.flatten(1) @ shared[0].flatten(0, 1)

    values_of_row = num_cells * in_channels + out_channels
    return by_blocks(
        compute,
        features,
        per_edge=(reads.fractions, reads.weights),
        shared=(filters,),
        graph=Graph(reads.row_splits, reads.senders, bool(own)),
        values=(values_of_row, num_cells + 2 * in_channels),
        outputs=out_channels,
        again=partial(_generally, reads=reads, own=own),
    )


def _generally(
    features: Tensor, per_edge: Sequence[Tensor], shared: Sequence[Tensor], reads: FilterReads, own: float
) -> Tensor:
    fractions, weights = per_edge
    return general.gather_then_multiply(features, shared[0], reads.with_weights(fractions, weights), own)


@dataclass(frozen=True)
class Graph:
    """The edges that blocks are cut from.

    Attributes:
        row_splits: Edges of receiver i stand at ``row_splits[i]:row_splits[i + 1]``, (N + 1,).
        senders: Sender of each edge (E,).
        one_set: Whether receivers are senders too, and their own features are read.
    """

    row_splits: Tensor
    senders: Tensor
    one_set: bool

    def blocks(self, values: tuple[int, int]) -> Iterator[Block]:
        """Cut into blocks of bounded memory.

        Args:
            values: Numbers that a receiver, and an edge, take in a block.
        """
        counts = self.row_splits.diff()
        splits = self.row_splits.cpu().numpy()
        number = np.diff(splits)
        padded = np.maximum(number, min(int(number.max(initial=0)), _WIDTH))
        reached = np.cumsum(values[0] + padded * values[1])
        bounds, total = [0], 0
        while bounds[-1] < len(number):
            end = max(int(np.searchsorted(reached, total + _BLOCK_VALUES, side="right")), bounds[-1] + 1)
            bounds.append(end)
            total = int(reached[end - 1])
        for first, last in zip(bounds[:-1], bounds[1:], strict=True):
            yield Block(
                rows=slice(first, last),
                edges=slice(int(splits[first]), int(splits[last])),
                counts=counts[first:last],
                largest=int(number[first:last].max()),
            )


def by_blocks(
    compute: Compute,
    features: Tensor,
    *,
    per_edge: Sequence[Tensor],
    shared: Sequence[Tensor],
    graph: Graph,
    values: tuple[int, int],
    outputs: int,
    again: Callable[[Tensor, Sequence[Tensor], Sequence[Tensor]], Tensor],
) -> Tensor:
    """Compute a function of features and edges for one block of receivers after another.

    Args:
        compute: Block, the features of the senders of its edges (E, C), those of its receivers (n, C; none if
            `graph.one_set` is false), its part of the values of edges, and the shared values, to its output.
        features: Features of the senders (M, C).
        per_edge: Values of edges, (E, ...) each.
        shared: Values that all blocks read, such as filters.
        graph: The edges.
        values: Numbers that a receiver, and an edge, take in a block.
        outputs: Number of columns of the output.
        again: The whole function of features, values of edges and shared values, for derivatives of derivatives.

    Returns:
        Output (N, outputs).
    """
    call = _Call(compute, graph, values, outputs, again, len(per_edge))
    return _ByBlocks.apply(call, features, *per_edge, *shared)


@dataclass(frozen=True)
class _Call:
    compute: Compute
    graph: Graph
    values: tuple[int, int]
    outputs: int
    again: Callable
    num_per_edge: int

    def of_block(self, block: Block, tensors: Sequence[Tensor]) -> list[Tensor]:
        """What a block reads of features, values of edges and shared values."""
        features, per_edge, shared = self.sorted(tensors)
        received = features[block.rows] if self.graph.one_set else features[:0]
        sent = features[self.graph.senders[block.edges]]
        return [sent, received, *(each[block.edges] for each in per_edge), *shared]

    def sorted(self, tensors: Sequence[T]) -> tuple[T, Sequence[T], Sequence[T]]:
        """Features, values of edges, shared values."""
        return tensors[0], tensors[1 : 1 + self.num_per_edge], tensors[1 + self.num_per_edge :]

    def run(self, block: Block, read: Sequence[Tensor]) -> Tensor:
        sent, received, *others = read
        return self.compute(block, sent, received, others[: self.num_per_edge], others[self.num_per_edge :])


class _ByBlocks(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, call: _Call, *tensors: Tensor) -> Tensor:
        ctx.save_for_backward(*tensors)
        ctx.call, ctx.precision = call, _precision_on(tensors[0].device)
        output = tensors[0].new_zeros(len(call.graph.row_splits) - 1, call.outputs)
        for block in call.graph.blocks(call.values):
            output[block.rows] = call.run(block, call.of_block(block, tensors))
        return output

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:
        call, tensors, needed = ctx.call, ctx.saved_tensors, ctx.needs_input_grad[1:]
        with ctx.precision():
            if torch.is_grad_enabled():  # the derivative is to be differentiated again
                return None, *_derived(call.again(*call.sorted(tensors)), tensors, needed, gradient, True)
            return None, *_summed_over_blocks(call, tensors, needed, gradient)


def _precision_on(device: torch.device) -> Callable[[], AbstractContextManager]:
    """What sets the precision of products to that of now, in the backward pass, where torch's autocast has ended."""
    kind = device.type
    if not (torch.amp.is_autocast_available(kind) and torch.is_autocast_enabled(kind)):
        return nullcontext
    return partial(torch.autocast, kind, dtype=torch.get_autocast_dtype(kind))


def _derived(
    output: Tensor, inputs: Sequence[Tensor], needed: Sequence[bool], gradient: Tensor, create_graph: bool = False
) -> list[Tensor | None]:
    """Derivatives with respect to the inputs that need one; None for the others, and where an output has none."""
    wanted = [each for each, is_needed in zip(inputs, needed, strict=True) if is_needed]
    found: Iterator[Tensor | None] = iter([None] * len(wanted))
    if output.requires_grad and wanted:
        found = iter(torch.autograd.grad(output, wanted, gradient, create_graph=create_graph, allow_unused=True))
    return [next(found) if is_needed else None for is_needed in needed]


def _summed_over_blocks(
    call: _Call, tensors: Sequence[Tensor], needed: Sequence[bool], gradient: Tensor
) -> list[Tensor | None]:
    derivatives = [
        torch.zeros_like(each) if is_needed else None for each, is_needed in zip(tensors, needed, strict=True)
    ]
    of_features, of_edges, of_shared = call.sorted(derivatives)
    needs = [needed[0], needed[0] and call.graph.one_set, *needed[1:]]
    for block in call.graph.blocks(call.values):
        with torch.enable_grad():
            read = [
                each.detach().requires_grad_(need)
                for each, need in zip(call.of_block(block, tensors), needs, strict=True)
            ]
            output = call.run(block, read)
        sent, received, *others = _derived(output, read, needs, gradient[block.rows])
        if of_features is not None and sent is not None:
            of_features.index_add_(0, call.graph.senders[block.edges], sent)
        if of_features is not None and received is not None:
            of_features[block.rows] += received
        for total, part in zip(of_edges, others[: call.num_per_edge], strict=True):
            if total is not None and part is not None:
                total[block.edges] = part
        for total, part in zip(of_shared, others[call.num_per_edge :], strict=True):
            if total is not None and part is not None:
                total += part
    return derivatives
