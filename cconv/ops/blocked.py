"""Continuous convolution on the CPU, block by block, which never stores anything of size N·K^D·C.

With the matrices S_k of the reads (row i, column j: weight with which the edge from j to i reads cell k), features F,
filters W_k and the output Y:

    gather first      Y = sum_k (S_k F) W_k         columns S_k F of a block of receivers stay in a core's cache
    multiply first    Y = sum_k S_k (F W_k)         products F W_k are small where C_out is

The derivatives are convolutions of the same kind along the reversed edges (the transpose), with dY for features and the
transposed filters. Gathering first along them gives columns T_k = S_kᵀ dY that serve both derivatives:

    dF = sum_k T_k W_kᵀ,   dW_k = Fᵀ T_k

Otherwise dF is read from products dY W_kᵀ, and dW_k = (S_k F)ᵀ dY from columns that are gathered again.
"""

from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from torch import Tensor

from cconv.ops import gathers, general
from cconv.ops.blocks import Sums, for_blocks, for_ranges
from cconv.ops.filter_reads import FilterReads
from cconv.ops.products import linear

_PRODUCT_BYTES = 2**25  # size of the products between multiplication and reading

Rows = tuple[np.ndarray, np.ndarray | None, np.ndarray]  # splits, order of the edges, neighbour of each edge


def gather_then_multiply(features: Tensor, filters: Tensor, reads: FilterReads, own: float) -> Tensor:
    """As `general.gather_then_multiply`; not differentiable with respect to positions."""
    return _BlockedConv.apply(features, filters, reads, own, _gather_then_multiply)


def multiply_then_read(features: Tensor, filters: Tensor, reads: FilterReads, own: float) -> Tensor:
    """As `general.multiply_then_read`; not differentiable with respect to positions."""
    return _BlockedConv.apply(features, filters, reads, own, _multiply_then_read)


def columns(features: Tensor, reads: FilterReads, own: float) -> Tensor:
    """As `general.columns`, in one piece; not differentiable."""
    gathered = features.new_empty(reads.num_receivers, reads.num_cells, features.shape[1])
    gather = _gather(features.detach().contiguous(), reads, own)
    for_ranges(reads.num_receivers, gathered.numel(), lambda first, last: gather(first, last, gathered[first:last]))
    return gathered.flatten(1)


class _BlockedConv(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, features: Tensor, filters: Tensor, reads: FilterReads, own: float, compute: Callable
    ) -> Tensor:
        ctx.save_for_backward(features, filters)
        ctx.reads, ctx.own = reads, own
        return compute(features.detach().contiguous(), filters.detach(), reads, own)

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:
        features, filters = ctx.saved_tensors
        of_features, of_filters = ctx.needs_input_grad[:2]
        if torch.is_grad_enabled():  # the derivative is to be differentiated again
            inputs = [t for t, needed in ((features, of_features), (filters, of_filters)) if needed]
            output = general.gather_then_multiply(features, filters, ctx.reads, ctx.own)
            found = iter(torch.autograd.grad(output, inputs, gradient, create_graph=True))
            return next(found) if of_features else None, next(found) if of_filters else None, None, None, None
        features, filters, gradient = features.detach().contiguous(), filters.detach(), gradient.contiguous()
        reads, own = ctx.reads, ctx.own
        in_channels, out_channels = filters.shape[1:]
        reads_products = general.multiplies_first(reads.num_receivers, reads.num_senders, out_channels, in_channels)
        if reads_products or (not of_features and in_channels < out_channels):
            derivatives = (
                _features_derivative(filters, gradient, reads, own) if of_features else None,
                _filters_derivative(features, filters, gradient, reads, own) if of_filters else None,
            )
        else:
            derivatives = _both_derivatives(features, filters, gradient, reads, own, of_features, of_filters)
        return *derivatives, None, None, None


def _gather_then_multiply(features: Tensor, filters: Tensor, reads: FilterReads, own: float) -> Tensor:
    num_cells, in_channels, out_channels = filters.shape
    weights = filters.reshape(num_cells * in_channels, out_channels).T.contiguous()
    output = features.new_empty(reads.num_receivers, out_channels)
    gather = _gather(features, reads, own)

    def visit(first: int, last: int, columns: Tensor, worker: int) -> None:
        gather(first, last, columns)
        output[first:last] = linear(columns.flatten(1), weights)

    _for_blocks(reads.num_receivers, reads, features, visit)
    return output


def _multiply_then_read(features: Tensor, filters: Tensor, reads: FilterReads, own: float) -> Tensor:
    rows = [(1, _by_receiver(reads)), (own, _own(reads))]
    return _read_products(features, filters, reads, rows, reads.num_receivers)


def _features_derivative(filters: Tensor, gradient: Tensor, reads: FilterReads, own: float) -> Tensor:
    rows = [(1, _by_sender(reads)), (own, _own(reads))]
    return _read_products(gradient, filters.transpose(1, 2), reads, rows, reads.num_senders)


def _filters_derivative(features: Tensor, filters: Tensor, gradient: Tensor, reads: FilterReads, own: float) -> Tensor:
    num_cells, in_channels, out_channels = filters.shape
    sums = Sums(features, (out_channels, num_cells * in_channels))
    gather = _gather(features, reads, own)

    def visit(first: int, last: int, columns: Tensor, worker: int) -> None:
        gather(first, last, columns)
        sums[worker].add_(linear(gradient[first:last].T, columns.flatten(1).T))

    _for_blocks(reads.num_receivers, reads, features, visit)
    return sums.total().T.reshape(filters.shape)


def _both_derivatives(
    features: Tensor,
    filters: Tensor,
    gradient: Tensor,
    reads: FilterReads,
    own: float,
    of_features: bool,
    of_filters: bool,
) -> tuple[Tensor | None, Tensor | None]:
    num_cells, in_channels, out_channels = filters.shape
    weights = filters.permute(1, 0, 2).reshape(in_channels, num_cells * out_channels)
    derivative = torch.empty_like(features)
    sums = Sums(features, (in_channels, num_cells * out_channels))
    gather = _gather_transposed(gradient, reads, own)

    def visit(first: int, last: int, columns: Tensor, worker: int) -> None:
        gather(first, last, columns)
        if of_features:
            derivative[first:last] = linear(columns.flatten(1), weights)
        if of_filters:
            sums[worker].add_(linear(features[first:last].T, columns.flatten(1).T))

    _for_blocks(reads.num_senders, reads, gradient, visit)
    by_cell = sums.total().reshape(in_channels, num_cells, out_channels).transpose(0, 1)
    return derivative if of_features else None, by_cell if of_filters else None


def _read_products(
    values: Tensor, filters: Tensor, reads: FilterReads, rows: list[tuple[float, Rows]], num_rows: int
) -> Tensor:
    """Sum for each row what its edges read from ``values @ filters``; `rows` lists the edges, with a factor each."""
    num_cells, in_channels, out_channels = filters.shape
    weights = filters.permute(0, 2, 1).reshape(num_cells * out_channels, in_channels)
    output = values.new_zeros(num_rows, out_channels)
    sums, edges = output.numpy(), _edges(reads)
    chunk = max(1, _PRODUCT_BYTES // max(1, len(weights) * values.element_size()))
    for start in range(0, len(values), chunk):
        products = linear(values[start : start + chunk], weights).unflatten(1, (num_cells, out_channels)).numpy()

        def visit(first: int, last: int, products: np.ndarray = products, start: int = start) -> None:
            for factor, lists in rows:
                if factor:
                    gathers.read(first, last, *lists, *edges, products, start, products.dtype.type(factor), sums)

        for_ranges(num_rows, len(reads.senders) * out_channels, visit)
    return output


def _for_blocks(
    num_rows: int, reads: FilterReads, values: Tensor, visit: Callable[[int, int, Tensor, int], None]
) -> None:
    """Call ``visit(first, last, columns, worker)`` for blocks of rows; `columns` (last - first, K^D, C) is not set."""
    num_cells, channels = reads.num_cells, values.shape[1]
    num_values = (num_rows * num_cells + len(reads.senders) * reads.num_corners) * channels

    def visit_columns(first: int, last: int, columns: Tensor, worker: int) -> None:
        visit(first, last, columns.unflatten(1, (num_cells, channels)), worker)

    for_blocks(num_rows, num_cells * channels, values, num_values, visit_columns)


def _by_receiver(reads: FilterReads) -> Rows:
    return reads.row_splits.numpy(), None, reads.senders.numpy()


def _by_sender(reads: FilterReads) -> Rows:
    splits, order = reads.by_sender
    return splits.numpy(), order.numpy(), reads.receivers.numpy()


def _own(reads: FilterReads) -> Rows:
    return reads.row_splits.numpy(), None, reads.receivers.numpy()


def _edges(reads: FilterReads) -> tuple[np.ndarray, ...]:
    offsets = np.array(reads.corner_offsets, dtype=np.int32)
    return *(t.detach().numpy() for t in (reads.cells, reads.fractions, reads.weights)), offsets


def _gather(features: Tensor, reads: FilterReads, own: float) -> Callable[[int, int, Tensor], None]:
    """Compute the columns S_k F of a block, for messages with ``own`` times the receiver's features."""
    values = features.numpy()
    arrays = (*_by_receiver(reads), *_edges(reads), values)
    if own:
        scaled = (*arrays, values.dtype.type(own))
        return lambda first, last, columns: gathers.gather_with_own(first, last, *scaled, columns.numpy())
    return lambda first, last, columns: gathers.gather(first, last, *arrays, columns.numpy())


def _gather_transposed(gradient: Tensor, reads: FilterReads, own: float) -> Callable[[int, int, Tensor], None]:
    """Compute the transposed columns T_k = S_kᵀ dY of a block."""
    values, edges = gradient.numpy(), _edges(reads)
    arrays = (*_by_sender(reads), *edges, values)
    own_arrays = (reads.row_splits.numpy(), *edges, values, values.dtype.type(own))

    def gather(first: int, last: int, columns: Tensor) -> None:
        gathers.gather(first, last, *arrays, columns.numpy())
        if own:
            gathers.add_own(first, last, *own_arrays, columns.numpy())

    return gather
