"""Differentiable radial convolution on the CPU, block by block, which never stores anything of the size of all edges.

Messages to a block of receivers are gathered into columns of radial terms, which stay in a core's cache, and multiplied
by the filters. The derivative with respect to features is a radial convolution of the same kind, of the output's
gradient along the reversed edges (the transpose) with transposed filters. Its columns T_b serve both derivatives:

    dF = sum_b T_b W_bᵀ,   dW_b = Fᵀ T_b

Columns of scalars hold projections and scalars, columns of vectors hold directed projections, directed scalars and the
vectors themselves, in this order.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from cconv.neighbors import Edges
from cconv.ops import gathers, radial_gathers
from cconv.ops.blocks import Sums, for_blocks, for_ranges
from cconv.ops.products import linear
from cconv.ops.workers import runs_compiled

Kinds = tuple[int, int]  # numbers of scalars and of vectors
Both = list[Tensor]  # matrices of scalars and of vectors


@dataclass(frozen=True, kw_only=True, eq=False)
class WeightedEdges:
    """Edges and their weights for convolutions along them and along the reversed ones.

    Attributes:
        edges: Pairs of receivers and senders.
        weights: Weight of each edge (E,), None for 1.
    """

    edges: Edges
    weights: Tensor | None

    @cached_property
    def by_sender(self) -> tuple[np.ndarray, np.ndarray]:
        """Edges in compressed rows by sender: splits (M + 1,), int64, and the edges in that order, int32."""
        return gathers.sort_by_sender(self.edges.senders.numpy(), self.edges.num_senders)

    def arrays(self) -> tuple[Any, ...]:
        """Displacements, distances, weights and cutoff for compiled loops."""
        edges = self.edges
        weights = edges.distances[:0] if self.weights is None else self.weights
        arrays = [tensor.detach().numpy() for tensor in (edges.displacements, edges.distances, weights)]
        return *arrays, arrays[0].dtype.type(edges.cutoff)


def applies(features: Tensor, weighted: WeightedEdges) -> bool:
    """Tell whether `convolve` can be used: on the CPU, where positions are not differentiated."""
    positions = (weighted.edges.displacements, weighted.weights)
    moved = any(tensor is not None and tensor.requires_grad for tensor in positions)
    return not (moved and torch.is_grad_enabled()) and runs_compiled(features)


def convolve(
    features: Tensor,
    scalar_filters: Tensor,
    vector_filters: Tensor,
    weighted: WeightedEdges,
    own: tuple[float, float],
    general: Callable[[Tensor, Tensor, Tensor], Tensor],
) -> Tensor:
    """Radial convolution without bias; equations in `cconv.nn.radial_conv`.

    Args:
        features: Scalars, then components of each vector (M, S + V · D).
        scalar_filters: Values at evenly spaced distances from 0 to the cutoff (B, S + V, S_out).
        vector_filters: (B, S + 2V, V_out).
        weighted: Edges and their weights.
        own: Message of an edge = sender's features + ``own`` times the receiver's; one for scalars, one for vectors.
        general: The same of features and filters in torch operations, for derivatives of derivatives.

    Returns:
        Scalars, then components of each vector, (N, S_out + V_out · D).
    """
    return _RadialConv.apply(features, scalar_filters, vector_filters, weighted, own, general)


def columns(
    features: Tensor, kinds: Kinds, weighted: WeightedEdges, own: tuple[float, float], num_terms: int
) -> tuple[Tensor, Tensor]:
    """Gather the messages into radial terms, (N, B · (S + V)) and (N · D, B · (S + 2V)), not differentiable.

    Multiplied by filters of scalars, flattened to (B · (S + V), S_out), and of vectors, (B · (S + 2V), V_out), they are
    the convolution.
    """
    (scalars, vectors), dim = kinds, weighted.edges.dim
    gathered = _along(_split(features.detach(), kinds, dim), weighted, own, num_terms)
    found = [features.new_empty(shape) for shape in gathered.shapes]

    def visit(first: int, last: int) -> None:
        gathered.gather(first, last, *(each[first:last].numpy() for each in found))

    num_values = 2 * gathered.num_edges * sum(shape[1] * shape[3] for shape in gathered.shapes)
    for_ranges(weighted.edges.num_receivers, num_values, visit)
    projected, themselves = found[0].split([vectors, scalars], dim=3)
    of_scalars = torch.cat([themselves, projected], dim=3)
    projected, directed, themselves = found[1].split([vectors, scalars, vectors], dim=3)
    of_vectors = torch.cat([directed, themselves, projected], dim=3)
    return of_scalars.flatten(0, 1).flatten(1), of_vectors.flatten(0, 1).flatten(1)


class _RadialConv(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any,
        features: Tensor,
        scalar_filters: Tensor,
        vector_filters: Tensor,
        weighted: WeightedEdges,
        own: tuple[float, float],
        general: Callable,
    ) -> Tensor:
        ctx.save_for_backward(features, scalar_filters, vector_filters)
        ctx.weighted, ctx.own, ctx.general = weighted, own, general
        filters = [scalar_filters.detach(), vector_filters.detach()]
        values = _split(features.detach(), _kinds(filters)[0], weighted.edges.dim)
        results, _ = _visit(_along(values, weighted, own, len(scalar_filters)), _by_output(filters), None)
        return _join(results, weighted.edges.dim)

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:
        tensors, needed = ctx.saved_tensors, ctx.needs_input_grad[:3]
        if torch.is_grad_enabled():  # the derivative is to be differentiated again
            wanted = [tensor for tensor, each in zip(tensors, needed, strict=True) if each]
            found = iter(torch.autograd.grad(ctx.general(*tensors), wanted, gradient, create_graph=True))
            return *(next(found) if each else None for each in needed), None, None, None
        features, *filters = (tensor.detach() for tensor in tensors)
        return *_derivatives(features, filters, gradient, ctx.weighted, ctx.own, needed), None, None, None


def _derivatives(
    features: Tensor,
    filters: Both,
    gradient: Tensor,
    weighted: WeightedEdges,
    own: tuple[float, float],
    needed: tuple[bool, ...],
) -> tuple[Tensor | None, ...]:
    """Derivatives with respect to features and filters from that with respect to the output, None if not needed."""
    (inputs, outputs), num_terms, dim = _kinds(filters), len(filters[0]), weighted.edges.dim
    values, outward = _split(features, inputs, dim), _split(gradient, outputs, dim)
    if not needed[0] and features.shape[1] < gradient.shape[1]:  # columns of the features are the smaller ones
        _, sums = _visit(_along(values, weighted, own, num_terms), None, outward)
        return None, *_from_by_output(sums, inputs, num_terms)
    columns, of_filters = _against(outward, weighted, own, num_terms), any(needed[1:])
    results, sums = _visit(columns, _by_input(filters) if needed[0] else None, values if of_filters else None)
    derivative = _join(results, dim) if needed[0] else None
    return derivative, *(_from_by_input(sums, outputs, num_terms) if of_filters else (None, None))


class _Columns(NamedTuple):
    """Columns of radial terms that edges gather, a block of rows at a time.

    Attributes:
        gather: Set columns (R, 1, B, V + S) and (R, D, B, 2V + S) of the rows from a first up to a last.
        shapes: Shapes of the columns of all rows.
        num_edges: Number of edges.
    """

    gather: Callable[..., None]
    shapes: tuple[tuple[int, int, int, int], ...]
    num_edges: int


def _along(values: Both, weighted: WeightedEdges, own: tuple[float, float], num_terms: int) -> _Columns:
    """Columns of messages at receivers."""
    edges = weighted.edges
    lists = edges.row_splits.numpy(), np.empty(0, np.int32), edges.receivers.numpy(), edges.senders.numpy()
    own_values = _rows([each * factor for each, factor in zip(values, own, strict=True)], edges.dim)
    messages = _rows(values, edges.dim), own_values if any(own) else own_values[:0], values[0].shape[1]
    arguments = *lists, *weighted.arrays(), *messages

    def gather(first: int, last: int, *columns: np.ndarray) -> None:
        radial_gathers.gather(first, last, *arguments, *columns)

    return _Columns(gather, _shapes(values, edges.num_receivers, num_terms, edges.dim), len(edges))


def _against(values: Both, weighted: WeightedEdges, own: tuple[float, float], num_terms: int) -> _Columns:
    """Columns of the transpose: at senders, along the reversed edges."""
    edges, rows, num_scalars = weighted.edges, _rows(values, weighted.edges.dim), values[0].shape[1]
    lists = *weighted.by_sender, edges.senders.numpy(), edges.receivers.numpy()
    arguments = *lists, *weighted.arrays(), rows, rows[:0], num_scalars
    of_own = edges.row_splits.numpy(), *weighted.arrays(), rows, num_scalars, *map(rows.dtype.type, own)

    def gather(first: int, last: int, *columns: np.ndarray) -> None:
        radial_gathers.gather(first, last, *arguments, *columns)
        if any(own):
            radial_gathers.add_own(first, last, *of_own, *columns)

    return _Columns(gather, _shapes(values, edges.num_senders, num_terms, edges.dim), len(edges))


def _visit(columns: _Columns, filters: Both | None, factors: Both | None) -> tuple[Both, Both]:
    """Multiply columns by filters, and sum up their products with factors.

    Args:
        columns: The columns.
        filters: Of scalars (S_out, B · (V + S)) and of vectors (V_out, B · (2V + S)); None without such results.
        factors: Of scalars (N, S_out) and of vectors (N · D, V_out); None without such sums.

    Returns:
        Results, shaped as `factors`, and sums, shaped as `filters`.
    """
    like, *_ = given = filters or factors or []
    counts = [each.shape[0 if filters else 1] for each in given]
    results = [like.new_empty(shape[0] * shape[1], count) for shape, count in zip(columns.shapes, counts, strict=True)]
    sums = [Sums(like, (count, math.prod(shape[2:]))) for shape, count in zip(columns.shapes, counts, strict=True)]
    # Columns of which nothing is asked have no width.
    shapes = [(*shape[1:3], shape[3] if count else 0) for shape, count in zip(columns.shapes, counts, strict=True)]
    sizes = [math.prod(shape) for shape in shapes]

    def visit(first: int, last: int, block: Tensor, worker: int) -> None:
        parts = block.flatten().split([(last - first) * size for size in sizes])
        gathered = [part.view(last - first, *shape) for part, shape in zip(parts, shapes, strict=True)]
        columns.gather(first, last, *(each.numpy() for each in gathered))
        for kind in (kind for kind in (0, 1) if counts[kind]):
            matrix, repeats = gathered[kind].flatten(2).flatten(0, 1), shapes[kind][0]
            rows = slice(first * repeats, last * repeats)
            if filters is not None:
                results[kind][rows] = linear(matrix, filters[kind])
            if factors is not None:
                sums[kind][worker].addmm_(factors[kind][rows].T, matrix)  # in `linear`, both would be copied

    num_rows, _, num_terms, _ = columns.shapes[0]
    num_values = sum(sizes) * (num_rows + 2 * columns.num_edges // num_terms)
    for_blocks(num_rows, sum(sizes), like, num_values, visit)
    return results, [each.total() for each in sums]


def _kinds(filters: Both) -> tuple[Kinds, Kinds]:
    """Kinds of inputs and of outputs."""
    (_, projected, scalar_outputs), (_, directed, vector_outputs) = (each.shape for each in filters)
    return (2 * projected - directed, directed - projected), (scalar_outputs, vector_outputs)


def _shapes(values: Both, num_rows: int, num_terms: int, dim: int) -> tuple[tuple[int, int, int, int], ...]:
    scalars, vectors = (each.shape[1] for each in values)
    return (num_rows, 1, num_terms, vectors + scalars), (num_rows, dim, num_terms, 2 * vectors + scalars)


def _split(values: Tensor, kinds: Kinds, dim: int) -> Both:
    """Scalars (N, S) and components of vectors (N · D, V) of values (N, S + V · D)."""
    scalars, vectors = values.split([kinds[0], kinds[1] * dim], dim=1)
    by_component = vectors.unflatten(1, (kinds[1], dim)).transpose(1, 2).contiguous()
    return [scalars.contiguous(), by_component.flatten(0, 1)]


def _join(values: Both, dim: int) -> Tensor:
    """The inverse of `_split`."""
    scalars, vectors = values
    by_vector = vectors.unflatten(0, (len(scalars), dim)).transpose(1, 2)
    return torch.cat([scalars, by_vector.flatten(1)], dim=1)


def _rows(values: Both, dim: int) -> np.ndarray:
    """Scalars, then the first components of all vectors, then the second ones, ..., of each point."""
    scalars, vectors = values
    return torch.cat([scalars, vectors.view(len(scalars), dim * vectors.shape[1])], dim=1).numpy()


def _by_output(filters: Both) -> Both:
    """Filters as `_visit` multiplies columns along the edges by them."""
    (scalars, vectors), _ = _kinds(filters)
    themselves, projected = filters[0].split([scalars, vectors], dim=1)
    to_scalars = torch.cat([projected, themselves], dim=1)
    directed, themselves, projected = filters[1].split([scalars, vectors, vectors], dim=1)
    to_vectors = torch.cat([projected, directed, themselves], dim=1)
    return [each.permute(2, 0, 1).flatten(1).contiguous() for each in (to_scalars, to_vectors)]


def _from_by_output(sums: Both, inputs: Kinds, num_terms: int) -> Both:
    """The inverse of `_by_output`."""
    scalars, vectors = inputs
    to_scalars, to_vectors = (each.unflatten(1, (num_terms, -1)).permute(1, 2, 0) for each in sums)
    projected, themselves = to_scalars.split([vectors, scalars], dim=1)
    of_scalars = torch.cat([themselves, projected], dim=1)
    projected, directed, themselves = to_vectors.split([vectors, scalars, vectors], dim=1)
    return [of_scalars, torch.cat([directed, themselves, projected], dim=1)]


def _by_input(filters: Both) -> Both:
    """Filters as `_visit` multiplies columns along the reversed edges by them."""
    (scalars, vectors), _ = _kinds(filters)
    of_scalars, of_projected = filters[0].split([scalars, vectors], dim=1)
    directed, themselves, projected = filters[1].split([scalars, vectors, vectors], dim=1)
    both = torch.cat([directed, of_scalars], dim=2), torch.cat([projected, of_projected, themselves], dim=2)
    return [each.transpose(0, 1).flatten(1).contiguous() for each in both]


def _from_by_input(sums: Both, outputs: Kinds, num_terms: int) -> Both:
    """The inverse of `_by_input`."""
    scalars, vectors = outputs
    from_scalars, from_vectors = (each.unflatten(1, (num_terms, -1)).transpose(0, 1) for each in sums)
    directed, of_scalars = from_scalars.split([vectors, scalars], dim=2)
    projected, of_projected, themselves = from_vectors.split([vectors, scalars, vectors], dim=2)
    return [torch.cat([of_scalars, of_projected], dim=1), torch.cat([directed, themselves, projected], dim=1)]
