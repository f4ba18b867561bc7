"""Compiled loops over edges with radial terms: where an edge reads them, and messages gathered into columns of terms.

Compiled as in `gathers`, but that sums may also change their order.
"""

import numpy as np
from numba import int32, njit, uintp

from cconv.compiled import compile_cached

_compile = compile_cached(nogil=True, fastmath={"contract", "reassoc"}, error_model="numpy")

EDGES_AT_A_TIME = 64  # number of edges that are placed at a time


@_compile
def place(distances, cutoff, num_terms, lower, shares):
    """Set the index of the filter value at or below each distance, and the weights of it and the next."""
    one, steps = distances.dtype.type(1), distances.dtype.type(num_terms - 1)
    largest = int32(max(num_terms - 2, 0))
    for k in range(uintp(len(distances))):
        at = distances[k] / cutoff * steps
        lower[k] = min(int32(at), largest)
        shares[1, k] = min(at - distances.dtype.type(lower[k]), one)
        shares[0, k] = one - shares[1, k]


@_compile
def scale(weights, shares):
    """Multiply the weights of both filter values by those of the edges."""
    for k in range(uintp(len(weights))):
        shares[0, k] *= weights[k]
        shares[1, k] *= weights[k]


@_compile
def point(displacements, distances, directions):
    """Set the directions (D, E) from receivers to senders, 0 where two points coincide."""
    one = distances.dtype.type(1)
    for k in range(uintp(len(distances))):
        inverse = -one / (distances[k] if distances[k] > 0 else one)
        for axis in range(uintp(len(directions))):
            directions[axis, k] = displacements[k, axis] * inverse


@_compile
def _look_up(
    start, stop, order, displacements, distances, weights, cutoff, num_terms, edges, lower, shares, directions
):  # fmt: skip
    """Set the edges from `start` up to `stop` of an order, and their filter values, weights of these and directions.

    An empty `order` stands for edges in their own order, empty `weights` for 1. Returns the number of edges.
    """
    count, dim = stop - start, displacements.shape[1]
    apart, far = np.empty((count, dim), distances.dtype), np.empty(count, distances.dtype)
    for k in range(count):
        edges[k] = order[start + k] if len(order) > 0 else start + k
        far[k] = distances[edges[k]]
        for axis in range(dim):
            apart[k, axis] = displacements[edges[k], axis]
    place(far, cutoff, num_terms, lower, shares)
    point(apart, far, directions)
    if len(weights) > 0:
        for k in range(count):
            far[k] = weights[edges[k]]
        scale(far, shares)
    return uintp(count)


@njit(inline="always")
def _add(factor, values, start, count, sums, here):
    """Add ``factor * values`` from `start` on to `sums` from `here` on."""
    for c in range(count):
        sums[here + c] += factor * values[start + c]


@njit(inline="always")
def _add_to_terms(below, above, values, start, count, sums, here, step):
    """The same at the two terms that an edge reads, `step` apart."""
    for c in range(count):
        sums[here + c] += below * values[start + c]
        sums[here + step + c] += above * values[start + c]


@_compile
def gather(
    first, last, splits, order, rows, neighbors, displacements, distances, weights, cutoff, values, own_values,
    num_scalars, scalar_columns, vector_columns,
):  # fmt: skip
    """Set columns of the rows from `first` up to `last` to the sums of messages for each radial term.

    Messages are ``values[neighbor] + own_values[row]``, the latter if there are any. Values hold scalars, then the
    first components of all vectors, then the second ones, ...: (M, S + D · V). `splits` and `order` list the edges of
    each row; an empty `order` stands for edges that are sorted by row, empty `weights` for 1.

    Args:
        scalar_columns: Projections, scalars: (last - first, 1, B, V + S), or of width 0.
        vector_columns: Directed projections and scalars, vectors: (last - first, D, B, 2V + S), or of width 0.
    """
    # Unsigned indices in one row of values, as in `gathers.read`.
    num_terms, num_values, dim = uintp(vector_columns.shape[2]), uintp(values.shape[1]), uintp(displacements.shape[1])
    num_vectors = (num_values - uintp(num_scalars)) // dim
    num_projected, zero = num_vectors + uintp(num_scalars), uintp(0)
    sent, own, to_scalars, to_vectors = (
        values.reshape(-1), own_values.reshape(-1), scalar_columns.reshape(-1), vector_columns.reshape(-1)
    )  # fmt: skip
    scalar_width, vector_width = uintp(scalar_columns.shape[3]), uintp(vector_columns.shape[3])
    scalar_step, vector_step = (scalar_width, vector_width) if num_terms > 1 else (zero, zero)
    edges, lower = np.empty(EDGES_AT_A_TIME, np.int64), np.empty(EDGES_AT_A_TIME, np.int32)
    shares, directions = np.empty((2, len(edges)), values.dtype), np.empty((dim, len(edges)), values.dtype)
    message = np.empty(num_vectors + num_values, values.dtype)  # projections, scalars, components
    to_scalars[:] = 0
    to_vectors[:] = 0
    for start in range(splits[first], splits[last], EDGES_AT_A_TIME):
        stop = min(start + EDGES_AT_A_TIME, splits[last])
        count = _look_up(
            start, stop, order, displacements, distances, weights, cutoff, vector_columns.shape[2],
            edges, lower, shares, directions,
        )  # fmt: skip
        for k in range(count):
            row, neighbor = uintp(rows[uintp(edges[k])]), uintp(neighbors[uintp(edges[k])])
            if len(own) > 0:
                for c in range(num_values):
                    message[num_vectors + c] = sent[neighbor * num_values + c] + own[row * num_values + c]
            else:
                for c in range(num_values):
                    message[num_vectors + c] = sent[neighbor * num_values + c]
            for c in range(num_vectors):
                message[c] = directions[0, k] * message[num_projected + c]
            for axis in range(uintp(1), dim):
                _add(directions[axis, k], message, num_projected + axis * num_vectors, num_vectors, message, zero)
            below, above, place = shares[0, k], shares[1, k], row - uintp(first)
            # A variable for the lower term would make these loops two to three times as slow.
            if scalar_width > 0:
                here = (place * num_terms + uintp(lower[k])) * scalar_width
                _add_to_terms(below, above, message, zero, num_projected, to_scalars, here, scalar_step)
            if vector_width > 0:
                for axis in range(dim):
                    component, along = num_projected + axis * num_vectors, directions[axis, k]
                    here = ((place * dim + axis) * num_terms + uintp(lower[k])) * vector_width
                    _add_to_terms(
                        below * along, above * along, message, zero, num_projected, to_vectors, here, vector_step
                    )
                    here += num_projected
                    _add_to_terms(below, above, message, component, num_vectors, to_vectors, here, vector_step)


@_compile
def add_own(
    first, last, splits, displacements, distances, weights, cutoff, values, num_scalars,
    own_scalars, own_vectors, scalar_columns, vector_columns,
):  # fmt: skip
    """Add what `gather` would for messages ``values[row]`` times a factor a kind of columns; edges sorted by row."""
    num_terms, num_values, dim = uintp(vector_columns.shape[2]), uintp(values.shape[1]), uintp(displacements.shape[1])
    num_vectors = (num_values - uintp(num_scalars)) // dim
    mine, to_scalars, to_vectors = values.reshape(-1), scalar_columns.reshape(-1), vector_columns.reshape(-1)
    scalar_width, vector_width = uintp(scalar_columns.shape[3]), uintp(vector_columns.shape[3])
    edges, lower = np.empty(EDGES_AT_A_TIME, np.int64), np.empty(EDGES_AT_A_TIME, np.int32)
    shares, directions = np.empty((2, len(edges)), values.dtype), np.empty((dim, len(edges)), values.dtype)
    order, zero, moment_width = np.empty(0, np.int32), uintp(0), (uintp(1) + dim) * (uintp(1) + dim)
    moment_step = moment_width if num_terms > 1 else zero
    moments = np.ones(moment_width, values.dtype)  # 1, direction; each component of it, its products with all
    sums = np.empty((num_terms, uintp(1) + dim, uintp(1) + dim), values.dtype)
    flat_sums = sums.reshape(-1)
    for row in range(uintp(first), uintp(last)):
        sums[:] = 0
        for start in range(splits[row], splits[row + uintp(1)], EDGES_AT_A_TIME):
            stop = min(start + EDGES_AT_A_TIME, splits[row + uintp(1)])
            count = _look_up(
                start, stop, order, displacements, distances, weights, cutoff, vector_columns.shape[2],
                edges, lower, shares, directions,
            )  # fmt: skip
            for k in range(count):
                for axis in range(dim):
                    along = directions[axis, k]
                    moments[uintp(1) + axis] = along
                    here = (uintp(1) + axis) * (uintp(1) + dim)
                    moments[here] = along
                    for other in range(dim):
                        moments[here + uintp(1) + other] = along * directions[other, k]
                here = uintp(lower[k]) * moment_width
                _add_to_terms(shares[0, k], shares[1, k], moments, zero, moment_width, flat_sums, here, moment_step)
        scalars, place = row * num_values, row - uintp(first)
        vectors = scalars + uintp(num_scalars)
        for term in range(num_terms):
            if own_scalars != 0 and scalar_width > 0:
                here = (place * num_terms + term) * scalar_width
                for other in range(dim):
                    component, factor = vectors + other * num_vectors, own_scalars * sums[term, 0, 1 + other]
                    _add(factor, mine, component, num_vectors, to_scalars, here)
                here += num_vectors
                _add(own_scalars * sums[term, 0, 0], mine, scalars, uintp(num_scalars), to_scalars, here)
            if own_vectors != 0 and vector_width > 0:
                for axis in range(dim):
                    here = ((place * dim + axis) * num_terms + term) * vector_width
                    for other in range(dim):
                        component, factor = vectors + other * num_vectors, own_vectors * sums[term, 1 + axis, 1 + other]
                        _add(factor, mine, component, num_vectors, to_vectors, here)
                    here += num_vectors
                    along = own_vectors * sums[term, 0, 1 + axis]
                    _add(along, mine, scalars, uintp(num_scalars), to_vectors, here)
                    here += uintp(num_scalars)
                    component = vectors + axis * num_vectors
                    _add(own_vectors * sums[term, 0, 0], mine, component, num_vectors, to_vectors, here)
