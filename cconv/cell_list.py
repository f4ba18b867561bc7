"""Neighbour search with a cell list: pairs of points within a cutoff, by compiled loops without Python's lock.

Cells are as wide as the cutoff. Only cells that hold a point are kept, sorted by their number, so memory and time
depend on the number of points, not on the extent of the domain. Adjacent cells along the last axis have consecutive
numbers, so a point finds its neighbours in a few runs of consecutive sorted points. Compiled code is cached on disk.
"""

import math
from dataclasses import dataclass

import numpy as np
from numba import uintp

from cconv.compiled import compile_cached

_compile = compile_cached(nogil=True, error_model="numpy")

_MAX_CELLS = 2**20  # along an axis: numbers of cells in three dimensions fit 63 bits, with room for one more
_MARGIN = 1 + 1e-6  # of a cell's width over the cutoff, well above the rounding of coordinates counted in cells
_SAMPLE = 1000  # number of points that estimate the middle of all


@dataclass(frozen=True, kw_only=True)
class Cells:
    """Points sorted by the cell that they lie in.

    Attributes:
        numbers: Cell of each point, (N,), int64, ascending.
        points: Coordinates (3, N), float64; axes that the points do not have come first and are 0.
        order: Index of each point before it was sorted, (N,), int32.
    """

    numbers: np.ndarray
    points: np.ndarray
    order: np.ndarray


@dataclass(frozen=True, kw_only=True)
class CellGrid:
    """The positions of the cells. Axes that the points do not have come first, with one cell.

    Attributes:
        cutoff: Largest distance of a pair, inclusive.
        counts: Cells along each axis, (3,), int64.
        origin: Lower end of the first cell, (3,).
        widths: Width of a cell, at least the cutoff, (3,).
        lengths: Lengths of periodic axes, infinite for others, (3,).
    """

    cutoff: float
    counts: np.ndarray
    origin: np.ndarray
    widths: np.ndarray
    lengths: np.ndarray

    @classmethod
    def around(cls, points: np.ndarray, cutoff: float, lengths: np.ndarray) -> "CellGrid":
        """Cells around the middle of points (N, D); open axes have all cells that can be numbered.

        Points beyond these are put into the outermost cells, which only costs time.

        Args:
            points: Coordinates; along periodic axes from 0 to the length.
            cutoff: Largest distance of a pair, at most half the length of a periodic axis.
            lengths: Lengths of periodic axes, infinite for others, (D,).
        """
        width = _MARGIN * cutoff
        sample = points[:: len(points) // _SAMPLE + 1]
        middle = np.median(sample, axis=0) if len(sample) else np.zeros(len(lengths))
        rows = [(1, 0.0, math.inf, math.inf)] * (3 - len(lengths))
        for length, center in zip(lengths, middle, strict=True):
            if math.isfinite(length):
                count = int(min(max(length // width, 1), _MAX_CELLS - 1))
                rows.append((count, 0.0, length / count, length))
            else:
                rows.append((_MAX_CELLS, center - width * (_MAX_CELLS // 2), width, math.inf))
        counts, origin, widths, lengths = (np.array(column) for column in zip(*rows, strict=True))
        return cls(cutoff=cutoff, counts=counts, origin=origin, widths=widths, lengths=lengths)

    def sort(self, points: np.ndarray) -> Cells:
        """Points (N, D), float64, sorted by their cells."""
        numbers = _cell_numbers(points, self.origin, self.widths, self.counts)
        order = np.argsort(numbers)
        return Cells(numbers=numbers[order], points=_columns(points, order), order=order.astype(np.int32))


def pairs_by_receiver(
    receivers: Cells, senders: Cells, grid: CellGrid, include_self: bool
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Find the pairs within the cutoff in compressed rows by receiver, senders ascending within a row.

    Args:
        receivers: Receiving points.
        senders: Sending points; the same object where both are the same points.
        grid: Cells of both.
        include_self: Whether a point is its own neighbour, where both are the same points.

    Returns:
        Splits (N + 1,), receivers (E,) and senders (E,), int64.
    """
    skips_self = receivers is senders and not include_self
    found = _find(*_arrays(senders), *_arrays(receivers), grid.counts, grid.lengths, grid.cutoff, skips_self)
    return _transpose(*found, len(receivers.order))


def half_pairs(points: Cells, grid: CellGrid) -> np.ndarray:
    """Find the pairs of different points within the cutoff, each listed once: (P, 2), int64."""
    arrays = _arrays(points)
    return _listed_once(*_find(*arrays, *arrays, grid.counts, grid.lengths, grid.cutoff, True))


def _arrays(cells: Cells) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    return cells.numbers, cells.points, cells.order


@_compile
def separations(to, origin, row_splits, senders, lengths):
    """Return minimum-image displacement (E, D) and distance of each pair, from the sender's `origin` to the receiver.

    In the dtype of the points, rounded as `Box.displacement` does; `lengths` (D,) are infinite along open axes.
    """
    dim = to.shape[1]
    displacements = np.empty((len(senders), dim), to.dtype)
    distances = np.empty(len(senders), to.dtype)
    wraps = min(lengths) < math.inf
    for i in range(len(row_splits) - 1):
        for edge in range(uintp(row_splits[i]), uintp(row_splits[i + 1])):
            j = uintp(senders[edge])
            squared = to.dtype.type(0)
            for axis in range(uintp(dim)):
                difference = to[i, axis] - origin[j, axis]
                if wraps and lengths[axis] < math.inf:
                    difference -= lengths[axis] * np.rint(difference / lengths[axis])
                displacements[edge, axis] = difference
                squared += difference * difference
            distances[edge] = math.sqrt(squared)
    return displacements, distances


@_compile
def _cell_numbers(points, origin, widths, counts):
    """Number of the cell of each point (N, D), (N,)."""
    numbers = np.empty(len(points), np.int64)
    missing = 3 - points.shape[1]
    for i in range(len(points)):
        number = 0
        for axis in range(missing, 3):
            count = counts[axis]
            # The outermost cells of an open axis stay empty, so that the cells beside each have numbers.
            margin = 1.0 if count == _MAX_CELLS else 0.0
            cell = math.floor((points[i, axis - missing] - origin[axis]) / widths[axis])
            number = number * count + int(min(max(cell, margin), count - 1 - margin))
        numbers[i] = number
    return numbers


@_compile
def _columns(points, order):
    """Coordinates (3, N) of points (N, D) in an order."""
    columns = np.zeros((3, len(order)))
    missing = 3 - points.shape[1]
    for place in range(len(order)):
        for axis in range(points.shape[1]):
            columns[missing + axis, place] = points[order[place], axis]
    return columns


@_compile
def _adjacent_cells(cell, count):
    """Return the cells at and adjacent to `cell` along an axis as two ranges; the first of them may be empty.

    At the ends of an axis the range wraps around. Points reach the ends on periodic axes only.
    """
    if count <= 3:
        return 0, -1, 0, count - 1
    if cell == 0:
        return count - 1, count - 1, 0, 1
    if cell == count - 1:
        return 0, 0, count - 2, count - 1
    return 0, -1, cell - 1, cell + 1


@_compile
def _lower_bound(numbers, number, hint):
    """Return the lower bound of `number` in the ascending `numbers`, by a galloping search from `hint`."""
    low = hint if hint == 0 or numbers[hint - 1] < number else 0
    high, step = low, 1
    while high < len(numbers) and numbers[high] < number:
        low = high + 1
        high += step
        step *= 2
    high = min(high, len(numbers))
    while low < high:
        middle = (low + high) // 2
        if numbers[middle] < number:
            low = middle + 1
        else:
            high = middle
    return low


@_compile
def _runs_around(number, numbers, counts, runs):
    """Set `runs` (R, 2) to the index ranges of the points in a cell and its neighbours; some may be empty.

    The search starts at the previous content of `runs`. Returns the numbers of runs and of points.
    """
    x, y, z = number // counts[2] // counts[1], number // counts[2] % counts[1], number % counts[2]
    xs, ys, zs = _adjacent_cells(x, counts[0]), _adjacent_cells(y, counts[1]), _adjacent_cells(z, counts[2])
    count = num_points = 0
    for x_range in range(0, 4, 2):
        for y_range in range(0, 4, 2):
            for i in range(xs[x_range], xs[x_range + 1] + 1):
                for j in range(ys[y_range], ys[y_range + 1] + 1):
                    row = (i * counts[1] + j) * counts[2]
                    for z_range in range(0, 4, 2):
                        if zs[z_range] <= zs[z_range + 1]:
                            runs[count, 0] = _lower_bound(numbers, row + zs[z_range], runs[count, 0])
                            runs[count, 1] = _lower_bound(numbers, row + zs[z_range + 1] + 1, runs[count, 0])
                            num_points += runs[count, 1] - runs[count, 0]
                            count += 1
    return count, num_points


@_compile
def _with_room(array, used, size):
    """Return the array, or a larger copy of its first `used` members if it is shorter than `size`."""
    if size <= len(array):
        return array
    larger = np.empty(2 * size, array.dtype)
    for place in range(used):  # slices would take seconds longer to compile
        larger[place] = array[place]
    return larger


@_compile
def _copy_runs(runs, points, order, near, near_order):
    """Copy the points in `runs`, so that they lie side by side."""
    place = uintp(0)
    for run in range(len(runs)):
        for j in range(uintp(runs[run, 0]), uintp(runs[run, 1])):
            near[0, place], near[1, place], near[2, place] = points[0, j], points[1, j], points[2, j]
            near_order[place] = order[j]
            place += uintp(1)


@_compile
def _append_close(x, y, z, near, near_order, lengths, squared_cutoff, skipped, squared, found, num_found):
    """Append to `found` the points of `near` within the cutoff of (x, y, z); returns the new length of `found`."""
    length_x, length_y, length_z = lengths[0], lengths[1], lengths[2]
    count = uintp(len(near_order))
    for j in range(count):  # in a loop of its own, so that the compiler vectorises it
        dx, dy, dz = abs(x - near[0, j]), abs(y - near[1, j]), abs(z - near[2, j])
        dx, dy, dz = min(dx, length_x - dx), min(dy, length_y - dy), min(dz, length_z - dz)
        squared[j] = dx * dx + dy * dy + dz * dz
    for j in range(count):  # without a branch, which the processor could not predict
        found[num_found] = near_order[j]
        num_found += uintp((squared[j] <= squared_cutoff) & (near_order[j] != skipped))
    return num_found


@_compile
def _find(numbers, points, order, other_numbers, others, other_order, counts, lengths, cutoff, skips_self):
    """Find the other points within the cutoff of each point: first and last index of each row, and unsorted rows."""
    starts, ends = np.zeros(len(order), np.int64), np.zeros(len(order), np.int64)
    found, num_found = np.empty(32 * len(order), np.int32), uintp(0)
    near, near_order, squared = np.empty((3, 0)), np.empty(0, np.int32), np.empty(0)
    runs = np.zeros((18, 2), np.int64)
    first = 0
    while first < len(order):
        last = first + 1
        while last < len(order) and numbers[last] == numbers[first]:
            last += 1
        num_runs, num_near = _runs_around(numbers[first], other_numbers, counts, runs)
        if num_near > len(squared):
            near, near_order, squared = (
                np.empty((3, 2 * num_near)),
                np.empty(2 * num_near, np.int32),
                np.empty(2 * num_near),
            )
        found = _with_room(found, num_found, num_found + (last - first) * num_near)
        _copy_runs(runs[:num_runs], others, other_order, near, near_order)
        for i in range(first, last):
            starts[order[i]] = num_found
            skipped = order[i] if skips_self else np.int32(-1)
            num_found = _append_close(
                points[0, i], points[1, i], points[2, i], near, near_order[:num_near], lengths, cutoff * cutoff,
                skipped, squared, found, num_found,
            )  # fmt: skip
            ends[order[i]] = num_found
        first = last
    return starts, ends, found


@_compile
def _transpose(starts, ends, found, num_rows):
    """Transpose the rows: from the points that each point found to the points that found each point, ascending."""
    splits = np.zeros(num_rows + 1, np.int64)
    for j in range(len(starts)):
        for place in range(uintp(starts[j]), uintp(ends[j])):
            splits[uintp(found[place]) + uintp(1)] += 1
    for i in range(num_rows):
        splits[i + 1] += splits[i]
    places = splits[:-1].copy()
    rows, finders = np.empty(splits[-1], np.int64), np.empty(splits[-1], np.int64)
    for j in range(len(starts)):
        for place in range(uintp(starts[j]), uintp(ends[j])):
            i = uintp(found[place])
            finders[uintp(places[i])] = j
            places[i] += 1
    for i in range(num_rows):
        for place in range(uintp(splits[i]), uintp(splits[i + 1])):
            rows[place] = i
    return splits, rows, finders


@_compile
def _listed_once(starts, ends, found):
    """List the pairs of a point with the found points that come before it."""
    count = 0
    for j in range(len(starts)):
        for place in range(starts[j], ends[j]):
            count += found[place] < j
    pairs, count = np.empty((count, 2), np.int64), 0
    for j in range(len(starts)):
        for place in range(starts[j], ends[j]):
            if found[place] < j:
                pairs[count, 0], pairs[count, 1] = found[place], j
                count += 1
    return pairs
