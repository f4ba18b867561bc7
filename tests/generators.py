"""Generators for processes of their own: a new process imports them by this module's name."""

import os
import signal

from cconv.errors import ConfigError


def write(folder, number, steps):
    for _ in range(steps):
        yield
    (folder / str(number)).write_text(f"{os.getpid()}")


def refuse():
    yield
    raise ConfigError("no such thing")


def die():
    yield
    os.kill(os.getpid(), signal.SIGKILL)
