"""Parallel execution of generators, each in a process of its own.

Parent and workers share nothing but pipes, which end with them. A queue, counter or event of multiprocessing is made of
semaphores with names, which stay in shared memory where all processes are killed at once.
"""

import multiprocessing
import os
import signal
import threading
from collections.abc import Callable, Iterable, Iterator, Sequence
from itertools import islice
from multiprocessing.connection import Connection, wait
from multiprocessing.context import SpawnContext, SpawnProcess

import torch

from cconv.errors import DataError


def available_cores() -> int:
    """Return the number of cores that this process may use; if unknown, all cores of the machine."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def side_by_side(generator: Callable[..., Iterable], calls: Sequence[tuple], workers: int) -> Iterator[None]:
    """Run ``generator(*call)`` to its end for every call; yields whenever one of them yields.

    Args:
        generator: A function that a new process can import.
        calls: Arguments of each call.
        workers: Number of processes; they share the cores.

    Raises:
        DataError: If a process is ended from outside.
        Exception: What a call raised.
    """
    context, waiting = multiprocessing.get_context("spawn"), iter(calls)
    threads = max(1, available_cores() // workers)
    processes: list[SpawnProcess] = []
    busy: list[Connection] = []
    try:
        for call in islice(waiting, workers):
            processes.append(_started(context, generator, call, threads, busy))
        while busy:
            ready = wait(busy)
            for connection in [each for each in busy if each in ready]:
                if not _received(connection):
                    yield
                    continue
                following: tuple | None = next(waiting, None)
                connection.send(following)
                if following is None:
                    busy.remove(connection)
    except (EOFError, ConnectionError) as error:
        raise DataError(
            "A worker process was ended from outside, perhaps for want of memory; take fewer workers and give "
            'the same command again. In a script, call `generate` under `if __name__ == "__main__":`.'
        ) from error
    finally:
        for process in processes:
            process.terminate()
        for process in processes:
            process.join()


def _started(
    context: SpawnContext, generator: Callable, call: tuple, threads: int, busy: list[Connection]
) -> SpawnProcess:
    """A process that works on a call; its connection is added to `busy`."""
    ours, its = context.Pipe()
    process = context.Process(target=_work, args=(its, generator, threads), daemon=True)
    process.start()
    its.close()
    busy.append(ours)
    ours.send(call)
    return process


def _received(connection: Connection) -> bool:
    """Whether what a worker said is that its call came to its end; raises what the call raised."""
    ended, error = connection.recv()
    if error is not None:
        raise error
    return ended


def _work(connection: Connection, generator: Callable, threads: int) -> None:
    """Run calls as they come, until None comes; say so at each thing that they yield and at their end."""
    torch.set_num_threads(threads)
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent says when to stop
    threading.Thread(target=_end_with_parent, daemon=True).start()
    for call in iter(connection.recv, None):
        try:
            for _ in generator(*call):
                connection.send((False, None))
        except Exception as error:
            connection.send((True, error))
        else:
            connection.send((True, None))


def _end_with_parent() -> None:
    """End this process when its parent has died."""
    parent = multiprocessing.parent_process()
    assert parent is not None  # this runs in workers alone
    parent.join()
    os._exit(1)
