"""Loops over rows that threads share, block by block or in one range a thread."""

from collections.abc import Callable

import torch
from torch import Tensor

from cconv.ops.workers import run_on_workers

_BLOCK_BYTES = 3 * 2**19  # size of the values that a thread works on: about a core's cache
_VALUES_PER_WORKER = 2**19  # set or read: fewer cost less than waking a thread


class Sums:
    """A sum to which each worker adds in a tensor of its own.

    Args:
        like: Tensor of the same dtype.
        shape: Shape of the sum.
    """

    def __init__(self, like: Tensor, shape: tuple[int, int]):
        self._parts = [like.new_zeros(shape) for _ in range(torch.get_num_threads())]

    def __getitem__(self, worker: int) -> Tensor:
        return self._parts[worker]

    def total(self) -> Tensor:
        """The sum of what all workers have added."""
        return sum(self._parts[1:], start=self._parts[0])


def for_blocks(
    num_rows: int, width: int, like: Tensor, num_values: int, visit: Callable[[int, int, Tensor, int], None]
) -> None:
    """Call ``visit(first, last, values, worker)`` for blocks of rows; `values` (last - first, width) are not set.

    Which worker visits which block follows from their numbers alone, so that sums come out the same every time.

    Args:
        num_rows: Number of rows.
        width: Number of values of a row.
        like: Tensor of the same dtype as the values.
        num_values: Number of values that are set or read in all blocks.
        visit: Work on a block.
    """
    threads = _num_workers(num_values)
    rows = max(16, min(512, _BLOCK_BYTES // max(1, width * like.element_size()), -(-num_rows // threads)))
    workers = max(1, min(threads, -(-num_rows // rows)))

    def work(worker: int) -> None:
        values = like.new_empty(rows, width)
        for first in range(worker * rows, num_rows, workers * rows):
            last = min(first + rows, num_rows)
            visit(first, last, values[: last - first], worker)

    run_on_workers(work, workers)


def for_ranges(num_rows: int, num_values: int, visit: Callable[[int, int], None]) -> None:
    """Call ``visit(first, last)`` for one range of rows a worker."""
    workers = _num_workers(num_values)
    bounds = [num_rows * worker // workers for worker in range(workers + 1)]
    run_on_workers(lambda worker: visit(bounds[worker], bounds[worker + 1]), workers)


def _num_workers(num_values: int) -> int:
    return max(1, min(torch.get_num_threads(), num_values // _VALUES_PER_WORKER))
