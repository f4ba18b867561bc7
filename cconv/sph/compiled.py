"""SPH sums as compiled loops over rows of neighbours: as fast as SPH gets here, without derivatives.

Kernels come from tables of cubic polynomials, within 1e-6 of their largest value; `cconv.sph.operators` is exact.
"""

from collections.abc import Callable
from functools import lru_cache
from typing import Any

import numpy as np
import torch
from numba import njit, uintp
from torch import Tensor

from cconv.neighbors import Edges
from cconv.ops.workers import run_on_workers
from cconv.sph.kernel_table import kernel_tables
from cconv.sph.kernels import AbstractKernel
from cconv.sph.operators import check_one_set, check_sum
from cconv.sph.pair_loops import look_up

_compile = njit(nogil=True, cache=True, fastmath={"contract"}, error_model="numpy")
_PAIRS_PER_WORKER = 50_000


class CompiledSums:
    """SPH sums with one kernel, whose tables are computed once.

    Args:
        kernel: W.
    """

    def __init__(self, kernel: AbstractKernel):
        self.kernel = kernel
        self._tables = {
            dtype: tuple(table.astype(dtype) for table in kernel_tables(kernel)) for dtype in (np.float32, np.float64)
        }

    def density(self, masses: Tensor, edges: Edges) -> Tensor:
        """Density by summation (D1) of the receivers (N,), particles themselves included, as `cconv.sph.density`.

        Raises:
            ShapeError: If `masses` does not fit the edges.
            ConfigError: If the kernel reaches further than the edges.
        """
        check_sum(edges, self.kernel, masses=(masses, (edges.num_senders,)))
        own = not (edges.bipartite or edges.includes_self)
        return self._sum(_densities, edges, masses, edges.num_receivers, self._values(masses), own)

    def density_rate(self, masses: Tensor, velocities: Tensor, edges: Edges) -> Tensor:
        """Material rate of density (D2) (N,), as `cconv.sph.density_rate`.

        Raises:
            ShapeError: If shapes do not fit the edges.
            ConfigError: If the edges are bipartite, or the kernel reaches further.
        """
        check_one_set(edges)
        particles = edges.num_senders
        check_sum(edges, self.kernel, masses=(masses, (particles,)), velocities=(velocities, (particles, edges.dim)))
        return self._sum(_rates, edges, masses, particles, self._slopes(masses), _array(velocities))

    def density_gradient(self, masses: Tensor, densities: Tensor, edges: Edges) -> Tensor:
        """Gradient of density (D3) (N, D), as `cconv.sph.density_gradient`.

        Raises:
            ShapeError: If shapes do not fit the edges.
            ConfigError: If the edges are bipartite, or the kernel reaches further.
        """
        check_one_set(edges)
        particles = edges.num_senders
        check_sum(edges, self.kernel, masses=(masses, (particles,)), densities=(densities, (particles,)))
        return self._sum(_gradients, edges, masses, (particles, edges.dim), self._slopes(masses), _array(densities))

    def velocity_gradient(self, volumes: Tensor, velocities: Tensor, edges: Edges) -> Tensor:
        """Gradient of the velocity (N, D, D), as `cconv.sph.velocity_gradient`.

        Raises:
            ShapeError: If shapes do not fit the edges.
            ConfigError: If the edges are bipartite, or the kernel reaches further.
        """
        check_one_set(edges)
        particles, dim = edges.num_senders, edges.dim
        check_sum(edges, self.kernel, volumes=(volumes, (particles,)), velocities=(velocities, (particles, dim)))
        shape, slopes = (particles, dim, dim), self._slopes(volumes)
        return self._sum(_velocity_gradients, edges, volumes, shape, slopes, _array(velocities))

    def _values(self, like: Tensor) -> np.ndarray:
        return self._tables[_array(like).dtype.type][0]

    def _slopes(self, like: Tensor) -> np.ndarray:
        return self._tables[_array(like).dtype.type][1]

    def _sum(
        self,
        loop: Callable,
        edges: Edges,
        masses: Tensor,
        shape: int | tuple[int, ...],
        table: np.ndarray,
        *others: Any,
    ) -> Tensor:
        """Run a loop over the rows, shared out among workers."""
        senders_masses, output = _array(masses), np.zeros(shape, table.dtype)
        splits, senders = edges.row_splits.numpy(), edges.senders.numpy()
        pairs = (splits, senders, _array(edges.displacements), _array(edges.distances))
        scale = table.dtype.type((len(table) - 1) / self.kernel.support_radius)
        workers = max(1, min(torch.get_num_threads(), len(senders) // _PAIRS_PER_WORKER))
        bounds = np.searchsorted(splits, np.linspace(0, len(senders), workers + 1))
        bounds[0], bounds[-1] = 0, edges.num_receivers

        def work(worker: int) -> None:
            loop(bounds[worker], bounds[worker + 1], *pairs, senders_masses, scale, table, *others, output)

        run_on_workers(work, workers)
        return torch.from_numpy(output)


@lru_cache(maxsize=16)
def compiled_sums(kernel: AbstractKernel) -> CompiledSums:
    """The sums with a kernel, whose tables are kept."""
    return CompiledSums(kernel)


def _array(values: Tensor) -> np.ndarray:
    return values.detach().contiguous().numpy()


@_compile
def _densities(first, last, splits, senders, displacements, distances, masses, scale, table, own, output):
    reach = len(table) - 1
    for i in range(uintp(first), uintp(last)):
        total = masses[i] * table[0, 3] if own else masses.dtype.type(0)
        for k in range(uintp(splits[i]), uintp(splits[i + 1])):
            place = distances[k] * scale
            if place < reach:
                total += masses[uintp(senders[k])] * look_up(table, place)
        output[i] = total


@_compile
def _rates(first, last, splits, senders, displacements, distances, masses, scale, table, velocities, output):
    reach, dim = len(table) - 1, displacements.shape[1]
    for i in range(uintp(first), uintp(last)):
        total = masses.dtype.type(0)
        for k in range(uintp(splits[i]), uintp(splits[i + 1])):
            distance = distances[k]
            place = distance * scale
            if place < reach and distance > 0:
                j = uintp(senders[k])
                approach = masses.dtype.type(0)
                for axis in range(uintp(dim)):
                    approach += (velocities[i, axis] - velocities[j, axis]) * displacements[k, axis]
                total += masses[j] * approach * look_up(table, place) / distance
        output[i] = total


@_compile
def _gradients(first, last, splits, senders, displacements, distances, masses, scale, table, densities, output):
    reach, dim = len(table) - 1, displacements.shape[1]
    for i in range(uintp(first), uintp(last)):
        for k in range(uintp(splits[i]), uintp(splits[i + 1])):
            distance = distances[k]
            place = distance * scale
            if place < reach and distance > 0:
                j = uintp(senders[k])
                factor = masses[j] * (densities[j] - densities[i]) * look_up(table, place) / distance
                for axis in range(uintp(dim)):
                    output[i, axis] += factor * displacements[k, axis]
        for axis in range(uintp(dim)):
            output[i, axis] /= densities[i]


@_compile
def _velocity_gradients(
    first, last, splits, senders, displacements, distances, volumes, scale, table, velocities, output
):
    reach, dim = len(table) - 1, displacements.shape[1]
    for i in range(uintp(first), uintp(last)):
        for k in range(uintp(splits[i]), uintp(splits[i + 1])):
            distance = distances[k]
            place = distance * scale
            if place < reach and distance > 0:
                j = uintp(senders[k])
                factor = volumes[j] * look_up(table, place) / distance
                for a in range(uintp(dim)):
                    change = factor * (velocities[j, a] - velocities[i, a])
                    for b in range(uintp(dim)):
                        output[i, a, b] += change * displacements[k, b]
