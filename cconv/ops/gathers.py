"""Compiled loops over edges: features into filter cells, and products out of them.

All work on numpy views of the tensors of `FilterReads`, on the rows from `first` up to `last`, without Python's lock.
Compiled code is cached on disk. Only contraction to fused multiply-adds is allowed, so that NaN and infinity stay.
"""

import numpy as np
from numba import njit, uintp

from cconv.compiled import compile_cached

_compile = compile_cached(nogil=True, fastmath={"contract"}, error_model="numpy")


@_compile
def sort_by_sender(senders, num_senders):
    """Edges in compressed rows by sender, a counting sort: splits (M + 1,), int64, and the edges in order, int32."""
    splits = np.zeros(num_senders + 1, np.int64)
    for sender in senders:
        splits[sender + 1] += 1
    splits = np.cumsum(splits)
    places = splits[:-1].copy()
    order = np.empty(len(senders), np.int32)
    for edge in range(len(senders)):
        order[places[senders[edge]]] = edge
        places[senders[edge]] += 1
    return splits, order


@njit(inline="always")
def _corner_weight(weight, fractions, corner, first_axis):
    for axis in range(first_axis, len(fractions)):
        upper = weight * fractions[axis]
        weight = upper if corner >> axis & 1 else weight - upper
    return weight


@njit(inline="always")
def _scatter_add(message, edge, cells, fractions, weights, corner_offsets, here):
    """Add the message of an edge to the cells that it reads."""
    # Two rows of cells at a time: few loads and stores, whatever the number of axes.
    for corner in range(0, len(corner_offsets), 2):
        both = _corner_weight(weights[edge], fractions[edge], corner, 1)
        upper_weight = both * fractions[edge, 0]
        lower_weight = both - upper_weight
        lower = here[cells[edge] + corner_offsets[corner]]
        upper = here[cells[edge] + corner_offsets[corner + 1]]
        for c in range(len(message)):
            value = message[c]
            lower[c] += lower_weight * value
            upper[c] += upper_weight * value


@njit(inline="always")
def _add_to_cell(message, edge, cells, weights, here):
    """Add the message of an edge to the one cell that it reads."""
    cell, weight = here[cells[edge]], weights[edge]
    for c in range(len(message)):
        cell[c] += weight * message[c]


@_compile
def gather(first, last, splits, order, neighbors, cells, fractions, weights, corner_offsets, values, columns):
    """Set columns (last - first, K^D, C) to the sums of ``values[neighbor]`` in each cell.

    `splits` and `order` list the edges of each row; None for `order` stands for edges that are sorted by row.
    """
    columns[: last - first] = 0
    interpolates = fractions.shape[1] > 0
    for row in range(first, last):
        here = columns[row - first]
        for place in range(splits[row], splits[row + 1]):
            edge = place if order is None else order[place]
            there = values[neighbors[edge]]
            if interpolates:
                _scatter_add(there, edge, cells, fractions, weights, corner_offsets, here)
            else:
                _add_to_cell(there, edge, cells, weights, here)


@_compile
def gather_with_own(
    first, last, splits, order, neighbors, cells, fractions, weights, corner_offsets, values, own, columns
):
    """As `gather`, of the messages ``values[neighbor] + own * values[row]``."""
    message = np.empty(values.shape[1], values.dtype)
    columns[: last - first] = 0
    interpolates = fractions.shape[1] > 0
    for row in range(first, last):
        here, mine = columns[row - first], values[row]
        for place in range(splits[row], splits[row + 1]):
            edge = place if order is None else order[place]
            there = values[neighbors[edge]]
            for c in range(len(message)):
                message[c] = there[c] + own * mine[c]
            if interpolates:
                _scatter_add(message, edge, cells, fractions, weights, corner_offsets, here)
            else:
                _add_to_cell(message, edge, cells, weights, here)


@_compile
def add_own(first, last, row_splits, cells, fractions, weights, corner_offsets, values, own, columns):
    """Add ``own * values[row]`` to the cells that the edges of each row read."""
    sums = np.empty(columns.shape[1], columns.dtype)
    for row in range(first, last):
        sums[:] = 0
        for edge in range(row_splits[row], row_splits[row + 1]):
            for corner in range(len(corner_offsets)):
                weight = _corner_weight(weights[edge], fractions[edge], corner, 0)
                sums[cells[edge] + corner_offsets[corner]] += weight
        for cell in range(len(sums)):
            weight = own * sums[cell]
            for c in range(values.shape[1]):
                columns[row - first, cell, c] += weight * values[row, c]


@_compile
def read(
    first, last, splits, order, neighbors, cells, fractions, weights, corner_offsets, products, start, own, output
):
    """Add to the output of each row what its edges read from the products of their neighbours, times `own`.

    `products` (P, K^D, C) are the products of the neighbours from `start` on; other neighbours are ignored.
    """
    # Unsigned indices in one row of values: signed ones, which may count from the end, cost half of the time.
    num_products, num_cells, channels = products.shape
    values, width = products.reshape(-1), uintp(channels)
    axes, corners = fractions.shape[1], len(corner_offsets)
    # Eight corners whatever the number of axes: along a missing one, the fraction is 0.
    o1, o2 = width * uintp(corner_offsets[1 % corners]), width * uintp(corner_offsets[2 % corners])
    o3, o4 = width * uintp(corner_offsets[3 % corners]), width * uintp(corner_offsets[4 % corners])
    o5, o6 = width * uintp(corner_offsets[5 % corners]), width * uintp(corner_offsets[6 % corners])
    o7 = width * uintp(corner_offsets[7 % corners])
    x = y = z = weights.dtype.type(0)
    for row in range(first, last):
        sums = output[row]
        for place in range(splits[row], splits[row + 1]):
            edge = uintp(place if order is None else order[place])
            neighbor = neighbors[edge] - start
            if not 0 <= neighbor < num_products:
                continue
            here, weight = width * uintp(neighbor * num_cells + cells[edge]), own * weights[edge]
            if axes > 0:
                x = fractions[edge, uintp(0)]
            if axes > 1:
                y = fractions[edge, uintp(1)]
            if axes > 2:
                z = fractions[edge, uintp(2)]
            for c in range(here, here + width):
                v0, v2, v4, v6 = values[c], values[c + o2], values[c + o4], values[c + o6]
                v0 += x * (values[c + o1] - v0)
                v2 += x * (values[c + o3] - v2)
                v4 += x * (values[c + o5] - v4)
                v6 += x * (values[c + o7] - v6)
                v0 += y * (v2 - v0)
                v4 += y * (v6 - v4)
                sums[c - here] += weight * (v0 + z * (v4 - v0))
