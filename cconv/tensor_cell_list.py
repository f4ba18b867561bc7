"""Neighbour search with a cell list in torch operations, for devices that compiled loops do not know.

As in `cconv.cell_list`, cells are as wide as the cutoff, and points are sorted by the number of their cell, so memory
and time depend on the number of points, not on the extent of the domain. Each receiver looks up the adjacent cells
among the sorted numbers of the senders' cells. Candidates are listed and measured for a part of the receivers at a
time; nothing has a capacity that could overflow. Distances are computed as the compiled search does, operation by
operation, so that both find the same pairs where both compute in the same precision.
"""

import itertools
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

_MARGIN = 1 + 1e-6  # of a cell's width over the cutoff, well above the rounding of coordinates counted in cells
_BITS = 60  # of the number of a cell, window included
_CANDIDATES = 2**22  # pairs of points that are measured at a time
_SAMPLE = 1000  # number of points that estimate the middle of all


@dataclass(frozen=True)
class _Axis:
    """Cells along an axis.

    Attributes:
        count: Their number.
        origin: Lower end of the first, a tensor of no dimension.
        width: Width of a cell, at least the cutoff.
        length: Length of a periodic axis, infinite for an open one.
    """

    count: int
    origin: Tensor
    width: float
    length: float

    @property
    def is_periodic(self) -> bool:
        return math.isfinite(self.length)

    def cells(self, coordinates: Tensor) -> Tensor:
        """Cell of each coordinate; beyond the ends the outermost one, which on an open axis has neighbours beside."""
        margin = 0 if self.is_periodic else 1
        found = torch.floor((coordinates - self.origin) / self.width)
        return found.clamp(margin, self.count - 1 - margin).long()

    @property
    def offsets(self) -> range:
        """Offsets of a cell and those beside it, each cell once."""
        return range(-1, 2) if not self.is_periodic or self.count >= 3 else range(self.count)

    @property
    def spans(self) -> list[tuple[int, int]]:
        """The offsets as ranges, both ends included, whose cells have consecutive numbers."""
        return [(each, each) for each in self.offsets] if self.is_periodic else [(-1, 1)]

    def shifted(self, cells: Tensor, offset: int) -> Tensor:
        """Cells at an offset."""
        return torch.remainder(cells + offset, self.count) if self.is_periodic else cells + offset


def pairs_by_receiver(
    receivers: Float[Tensor, "N D"],
    senders: Float[Tensor, "M D"],
    cutoff: float,
    lengths: Sequence[float],
    skips_self: bool,
    windows: tuple[Int[Tensor, " N"], Int[Tensor, " M"]] | None = None,
) -> tuple[Int[Tensor, " splits"], Int[Tensor, " E"], Int[Tensor, " E"]]:
    """Find the pairs within the cutoff in compressed rows by receiver, senders ascending within a row.

    Args:
        receivers: Receiving points (N, D), D from 1 to 3; along periodic axes from 0 to the length.
        senders: Sending points (M, D).
        cutoff: Largest distance of a pair, inclusive; at most half the length of every periodic axis.
        lengths: Lengths of periodic axes, infinite for others, D numbers.
        skips_self: Whether a receiver and the sender of the same number are no pair.
        windows: Window of each receiver and of each sender, from 0, where only points of the same window are pairs.

    Returns:
        Splits (N + 1,), receivers (E,) and senders (E,), int64, on the device of the points.
    """
    axes = _axes(receivers, cutoff, lengths, 0 if windows is None else _highest(windows))
    places, cells = (
        [axis.cells(along) for axis, along in zip(axes, points.unbind(1), strict=True)]
        for points in (receivers, senders)
    )
    first = [None, None] if windows is None else list(windows)
    numbers, order = _numbers(axes, cells, first[1]).sort(stable=True)
    starts, counts = _runs(axes, places, first[0], numbers)
    found = [
        _close(rows, ranges, receivers, senders, order, cutoff, lengths, skips_self)
        for rows, ranges in _parts(starts, counts)
    ]
    keys = torch.cat(found or [order[:0]]).sort().values
    rows, columns = keys // max(len(senders), 1), keys % max(len(senders), 1)
    ends = torch.bincount(rows, minlength=len(receivers)).cumsum(0)
    return torch.cat([ends.new_zeros(1), ends]), rows, columns


def _axes(points: Tensor, cutoff: float, lengths: Sequence[float], highest_window: int) -> list[_Axis]:
    """Cells around the middle of the points; open axes have all cells that can be numbered."""
    most = 2 ** ((_BITS - highest_window.bit_length()) // len(lengths))
    width = _MARGIN * cutoff
    sample = points[:: len(points) // _SAMPLE + 1]
    middle = sample.median(dim=0).values if len(sample) else points.new_zeros(len(lengths))
    axes = []
    for length, center in zip(lengths, middle, strict=True):
        if math.isfinite(length):
            count = int(min(max(length // width, 1), most))
            axes.append(_Axis(count, torch.zeros_like(center), length / count, length))
        else:
            axes.append(_Axis(most, center - width * (most // 2), width, math.inf))
    return axes


def _highest(windows: tuple[Tensor, Tensor]) -> int:
    return max((int(each[-1]) for each in windows if len(each)), default=0)


def _numbers(axes: Sequence[_Axis], cells: Sequence[Tensor], window: Tensor | None) -> Tensor:
    """Number of each cell, by window and axis by axis."""
    numbers = torch.zeros_like(cells[0]) if window is None else window
    for axis, along in zip(axes, cells, strict=True):
        numbers = numbers * axis.count + along
    return numbers


def _runs(
    axes: Sequence[_Axis], cells: Sequence[Tensor], window: Tensor | None, numbers: Tensor
) -> tuple[Tensor, Tensor]:
    """Runs of sorted points around each receiver: where each begins (R, N), and its number of points (R, N)."""
    starts: list[Tensor] = []
    ends: list[Tensor] = []
    *others, last = axes
    for offsets in itertools.product(*(axis.offsets for axis in others)):
        beside = [axis.shifted(along, by) for axis, along, by in zip(others, cells, offsets, strict=False)]
        for low, high in last.spans:
            bounds = [_numbers(axes, [*beside, last.shifted(cells[-1], by)], window) for by in (low, high)]
            starts.append(torch.searchsorted(numbers, bounds[0]))
            ends.append(torch.searchsorted(numbers, bounds[1], right=True))
    return torch.stack(starts), torch.stack(ends) - torch.stack(starts)


def _parts(starts: Tensor, counts: Tensor) -> Iterator[tuple[Tensor, tuple[Tensor, Tensor]]]:
    """Receivers (n,) with their runs (R, n), so many at a time as have few candidates together, but at least one."""
    reached = counts.sum(dim=0).cumsum(0)
    first = 0
    while first < len(reached):
        before = reached[first - 1] if first else reached.new_zeros(())
        last = max(int(torch.searchsorted(reached, before + _CANDIDATES, right=True)), first + 1)
        yield torch.arange(first, last, device=starts.device), (starts[:, first:last], counts[:, first:last])
        first = last


def _close(
    rows: Tensor,
    ranges: tuple[Tensor, Tensor],
    receivers: Tensor,
    senders: Tensor,
    order: Tensor,
    cutoff: float,
    lengths: Sequence[float],
    skips_self: bool,
) -> Tensor:
    """Pairs within the cutoff among the candidates of some receivers, as receiver · M + sender."""
    starts, counts = (each.flatten() for each in ranges)
    begins = counts.cumsum(0) - counts
    run = torch.arange(len(counts), device=rows.device).repeat_interleave(counts)
    place = torch.arange(len(run), device=rows.device) - (begins - starts)[run]
    i, j = rows[run % len(rows)], order[place]
    squared = torch.zeros(len(i), dtype=receivers.dtype, device=rows.device)
    for axis, length in enumerate(lengths):
        apart = (receivers[i, axis] - senders[j, axis]).abs()
        apart = torch.minimum(apart, length - apart) if math.isfinite(length) else apart
        squared = squared + apart * apart
    close = squared <= cutoff * cutoff
    if skips_self:
        close &= i != j
    return (i * len(senders) + j)[close]
