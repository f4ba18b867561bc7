"""Processes that tests start and end."""

import psutil

PATIENCE = 900  # seconds for a process that works: only one that hangs takes longer, also on a busy machine


def tree(pid):
    """A process and all that descend from it; none if it is gone."""
    try:
        process = psutil.Process(pid)
        return [process, *process.children(recursive=True)]
    except psutil.NoSuchProcess:
        return []


def kill_tree(pid):
    """SIGKILL a process and all that descend from it, also those that left its group."""
    processes = tree(pid)
    for process in processes:
        try:
            process.kill()
        except psutil.NoSuchProcess:
            continue
    psutil.wait_procs(processes, timeout=PATIENCE)


def names(pid):
    """Titles of a process and all that descend from it."""
    titles = []
    for process in tree(pid):
        try:
            titles.append(" ".join(process.cmdline()))
        except (psutil.NoSuchProcess, psutil.ZombieProcess):
            continue
    return titles
