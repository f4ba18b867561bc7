"""Radial convolution in compiled loops over a few hundred edges at a time, without arrays as large as all edges.

It runs on the CPU in float32 and float64 and is not differentiable. Each edge reads the filters of all inputs and
outputs, so it is fast only where these are few; else `radial_columns` is. Compiled as in `gathers`, but that sums may
also change their order.
"""

import numpy as np
import torch
from numba import uintp
from torch import Tensor

from cconv.compiled import compile_cached
from cconv.neighbors import Edges
from cconv.ops.radial_gathers import place, point, scale
from cconv.ops.workers import run_on_workers, runs_compiled

_compile = compile_cached(nogil=True, fastmath={"contract", "reassoc"}, error_model="numpy")

EDGES_AT_A_TIME = 512  # number of edges at a time: their values fit the innermost cache
MOST_READS = 64  # largest number of filters that an edge reads: for more, columns and a matrix product are faster
_READS_PER_WORKER = 2**19  # fewer cost less than waking a thread


def num_reads(inputs: tuple[int, int], outputs: tuple[int, int], dim: int) -> int:
    """Number of filters that an edge reads, from numbers of scalars and vectors; filters of vectors count D times."""
    (scalars, vectors), (to_scalars, to_vectors) = inputs, outputs
    directed = scalars + vectors
    return directed * to_scalars + (directed + dim * vectors) * to_vectors


def applies(features: Tensor, scalar_filters: Tensor, vector_filters: Tensor, edges: Edges) -> bool:
    """Tell whether `convolve` can be used and is fast: nothing to differentiate, few reads, the CPU."""
    tensors = (features, scalar_filters, vector_filters, edges.displacements)
    differentiated = torch.is_grad_enabled() and any(tensor.requires_grad for tensor in tensors)
    (_, directed, to_scalars), (_, of_vectors, to_vectors) = scalar_filters.shape, vector_filters.shape
    vectors = of_vectors - directed
    reads = num_reads((directed - vectors, vectors), (to_scalars, to_vectors), edges.dim)
    return not differentiated and reads <= MOST_READS and runs_compiled(features)


def convolve(
    features: Tensor,
    scalar_filters: Tensor,
    vector_filters: Tensor,
    edges: Edges,
    weights: Tensor | None,
    own: tuple[float, float],
) -> Tensor:
    """Radial convolution without bias; equations in `cconv.nn.radial_conv`.

    Args:
        features: Scalars, then components of vectors (M, S + V · D).
        scalar_filters: Values at evenly spaced distances from 0 to the cutoff (B, S + V, S_out).
        vector_filters: (B, S + 2V, V_out).
        edges: Pairs of receivers and senders.
        weights: Weight of each edge (E,), None for 1.
        own: Message of an edge = sender's features + ``own`` times the receiver's; one for scalars, one for vectors.

    Returns:
        Scalars, then components of vectors, (N, S_out + V_out · D).
    """
    values = features.detach().contiguous().numpy()
    filters = [_by_output(each) for each in (scalar_filters, vector_filters)]
    output = np.zeros((edges.num_receivers, len(filters[0]) + len(filters[1]) * edges.dim), values.dtype)
    tensors = (edges.row_splits, edges.receivers, edges.senders, edges.displacements, edges.distances)
    arrays = [tensor.detach().numpy() for tensor in tensors]
    weighted = None if weights is None else weights.detach().numpy()
    number = values.dtype.type
    arguments = (*arrays, weighted, number(edges.cutoff), values, *map(number, own), *filters, output)
    workers = _num_workers(len(edges) * sum(each[..., 0].size for each in filters))
    bounds = [edges.num_receivers * worker // workers for worker in range(workers + 1)]
    run_on_workers(lambda worker: _convolve_rows(bounds[worker], bounds[worker + 1], *arguments), workers)
    return torch.from_numpy(output)


def _by_output(filters: Tensor) -> np.ndarray:
    """Reorder filters (B, C_in, C_out) to (C_out, C_in, B + 1); the last value is repeated for the interpolation."""
    values = filters.detach().numpy()
    return np.ascontiguousarray(np.concatenate([values, values[-1:]]).transpose(2, 1, 0))


def _num_workers(reads: int) -> int:
    return max(1, min(torch.get_num_threads(), reads // _READS_PER_WORKER))


@_compile
def _convolve_rows(
    first, last, splits, receivers, senders, displacements, distances, weights, cutoff, features, own_scalars,
    own_vectors, scalar_filters, vector_filters, output,
):  # fmt: skip
    """Add the convolution at the receivers from `first` up to `last` to their rows of `output`."""
    dim, vectors = displacements.shape[1], vector_filters.shape[1] - scalar_filters.shape[1]
    scalars = scalar_filters.shape[1] - vectors
    lower, shares = np.empty(EDGES_AT_A_TIME, np.int32), np.empty((2, EDGES_AT_A_TIME), features.dtype)
    directions = np.empty((dim, EDGES_AT_A_TIME), features.dtype)
    messages = np.empty((scalars + vectors + vectors * dim, EDGES_AT_A_TIME), features.dtype)  # projections between
    terms = np.empty((output.shape[1], EDGES_AT_A_TIME), features.dtype)
    row = first
    for start in range(splits[first], splits[last], EDGES_AT_A_TIME):
        end = min(start + EDGES_AT_A_TIME, splits[last])
        count = uintp(end - start)
        place(distances[start:end], cutoff, scalar_filters.shape[2] - 1, lower, shares)
        if weights is not None:
            scale(weights[start:end], shares)
        point(displacements[start:end], distances[start:end], directions)
        pairs = receivers[start:end], senders[start:end]
        _gather(*pairs, features[:, :scalars], own_scalars, messages)
        _gather(*pairs, features[:, scalars:], own_vectors, messages[scalars + vectors :])
        _project(directions, count, scalars, vectors, messages)
        _set_scalars(messages, scalar_filters, lower, shares, count, terms)
        _set_vectors(messages, directions, vector_filters, lower, shares, count, scalars, terms[len(scalar_filters) :])
        row = _add_to_rows(terms, start, end, row, splits, output)


@_compile
def _gather(receivers, senders, features, own, messages):
    """Set a message of each edge (C, E) for features (M, C)."""
    for c in range(features.shape[1]):
        row = messages[c]
        if own:
            for k in range(uintp(len(senders))):
                row[k] = features[uintp(senders[k]), c] + own * features[uintp(receivers[k]), c]
        else:
            for k in range(uintp(len(senders))):
                row[k] = features[uintp(senders[k]), c]


@_compile
def _project(directions, count, scalars, vectors, messages):
    """Set the projections of the vectors among the messages on the directions."""
    dim = len(directions)
    for v in range(vectors):
        projections = messages[scalars + v]
        projections[:] = 0
        for axis in range(dim):
            component, direction = messages[scalars + vectors + v * dim + axis], directions[axis]
            for k in range(count):
                projections[k] += component[k] * direction[k]


@_compile
def _add_read(values, lower, shares, message, count, sums):
    """Add the filter value of each edge times its message."""
    for k in range(count):
        place = uintp(lower[k])
        sums[k] += (shares[0, k] * values[place] + shares[1, k] * values[place + uintp(1)]) * message[k]


@_compile
def _set_scalars(messages, filters, lower, shares, count, terms):
    """Set what each edge adds to the scalars, (S_out, E)."""
    for output in range(len(filters)):
        terms[output] = 0
        for c in range(filters.shape[1]):
            _add_read(filters[output, c], lower, shares, messages[c], count, terms[output])


@_compile
def _set_vectors(messages, directions, filters, lower, shares, count, scalars, terms):
    """Set what each edge adds to the components of the vectors, (V_out · D, E)."""
    dim = len(directions)
    vectors = (filters.shape[1] - scalars) // 2
    along = np.empty_like(directions[0])
    for output in range(len(filters)):
        along[:] = 0
        for c in range(scalars + vectors):  # directed scalars and projections, between which stand the vectors
            of = filters[output, c if c < scalars else c + vectors]
            _add_read(of, lower, shares, messages[c], count, along)
        for axis in range(dim):
            component = terms[output * dim + axis]
            for k in range(count):
                component[k] = along[k] * directions[axis, k]
            for v in range(vectors):
                message = messages[scalars + vectors + v * dim + axis]
                _add_read(filters[output, scalars + v], lower, shares, message, count, component)


@_compile
def _add_to_rows(terms, start, end, row, splits, output):
    """Add terms (C_out, E) of the edges from `start` up to `end`, the first of which is `row`'s; returns the last's."""
    edge = start
    while edge < end:
        while splits[row + 1] <= edge:
            row += 1
        stop = min(splits[row + 1], end)
        for c in range(output.shape[1]):
            total = output[row, c]
            for k in range(uintp(edge - start), uintp(stop - start)):
                total += terms[c, k]
            output[row, c] = total
        edge = stop
    return row
