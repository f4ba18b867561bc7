"""Threads that share a loop over blocks, each with torch restricted to one thread.

As many as `torch.get_num_threads()` of the calling thread, so that two processes of one thread each do not
oversubscribe two cores.
"""

import ctypes
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from functools import lru_cache
from multiprocessing import current_process
from typing import Any

import torch


def runs_compiled(values: torch.Tensor) -> bool:
    """Tell whether compiled loops take a tensor: they know the CPU and two precisions, no graph can hold them."""
    return (
        values.device.type == "cpu"
        and values.dtype in (torch.float32, torch.float64)
        and not torch.compiler.is_compiling()
        and not torch.is_autocast_enabled("cpu")
    )


def run_on_workers(work: Callable[[int], None], workers: int) -> None:
    """Call ``work(worker)`` for each worker from 0, each in a thread of its own; a single one runs in this thread.

    Args:
        work: Function of the number of the worker.
        workers: Number of workers, at most `torch.get_num_threads()`.
    """
    if workers == 1:
        work(0)
        return
    inference = torch.is_inference_mode_enabled()

    def isolated(worker: int) -> None:
        with torch.inference_mode(inference), torch.no_grad():
            work(worker)

    # A forked process has inherited the pool without its threads, hence one pool a process.
    pool = _pool(torch.get_num_threads(), current_process().pid)
    _dismiss_torch_threads()
    for done in [pool.submit(isolated, worker) for worker in range(workers)]:
        done.result()


def results_of(calls: Sequence[Callable[[], Any]]) -> list:
    """Return the results of `calls`, which run at the same time if torch has several threads; without derivatives."""
    if torch.get_num_threads() == 1:
        return [call() for call in calls]
    results = [None] * len(calls)

    def work(index: int) -> None:
        results[index] = calls[index]()

    run_on_workers(work, len(calls))
    return results


@contextmanager
def torch_threads(count: int) -> Iterator[None]:
    """Set the number of torch threads inside the block, and restore it afterwards."""
    before = torch.get_num_threads()
    torch.set_num_threads(count)
    try:
        yield
    finally:
        torch.set_num_threads(before)


@lru_cache(maxsize=4)
def _pool(threads: int, process: int) -> ThreadPoolExecutor:
    started = threading.Barrier(threads + 1)

    def start() -> None:
        torch.get_num_threads()  # a thread's first question or operation takes over the setting of the process
        torch.set_num_threads(1)
        started.wait()

    pool = ThreadPoolExecutor(threads, thread_name_prefix="cconv")
    for _ in range(threads):
        pool.submit(start)
    started.wait()
    # The workers' setting holds for their own threads, but is also what threads yet to be started would take.
    torch.set_num_threads(threads)
    return pool


def _dismiss_torch_threads() -> None:
    """End the idle threads that torch keeps for this thread; its next parallel operation starts new ones.

    After each operation they spin for up to several milliseconds on the cores that the workers need: on two cores a
    training step takes a third longer beside them.
    """
    pause, device = _openmp_pause()
    if pause is not None:
        pause(1, device)  # omp_pause_soft


@lru_cache(maxsize=1)
def _openmp_pause() -> tuple[Callable[[int, int], int] | None, int]:
    try:
        runtime = ctypes.CDLL(None)  # torch shares the symbols of its OpenMP runtime with the whole process
        return runtime.omp_pause_resource, runtime.omp_get_initial_device()
    except (AttributeError, OSError, TypeError):  # a runtime older than OpenMP 5.0, or none
        return None, 0
