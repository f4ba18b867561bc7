"""Errors that a user can act on: what must hold, what came, what to do."""

import difflib
import os
from collections.abc import Iterable
from errno import EDQUOT, ENOSPC

LONGEST_SHOWN = 100  # characters of a value in a message


class CConvError(ValueError):
    """Base of every error that `cconv` raises on purpose."""


class ShapeError(CConvError):
    """A tensor has the wrong shape, dtype or device."""


class ConfigError(CConvError):
    """A setting, study file, search space or checkpoint does not fit."""


class DataError(CConvError):
    """A file or folder of particle data is missing, damaged or inconsistent."""


class StudyError(CConvError):
    """A study whose input was right came to no result."""


class SimulationError(CConvError):
    """A simulation did not stay finite."""


def check_shape(name: str, shape: Iterable[int], expected: tuple[int | str, ...]) -> None:
    """Raise `ShapeError` unless `shape` matches `expected`; strings in `expected` match any length.

    Args:
        name: Name of the argument, for the message.
        shape: The shape that came.
        expected: What must hold, e.g. ``("particles", 3)``.
    """
    shape = tuple(shape)
    fits = len(shape) == len(expected) and all(
        isinstance(want, str) or have == want for have, want in zip(shape, expected, strict=True)
    )
    if not fits:
        wanted = ", ".join(str(axis) for axis in expected)
        raise ShapeError(f"`{name}` must have shape ({wanted}), got {shape}.")


def check_choice(name: str, value: object, choices: Iterable[str]) -> None:
    """Raise `ConfigError` unless `value` is one of `choices`; the message names the nearest."""
    choices = list(choices)
    if value not in choices:
        raise ConfigError(
            f"`{name}` must be one of {', '.join(choices)}, got {shown(value)}.{did_you_mean(value, choices)}"
        )


def did_you_mean(value: object, known: Iterable[str]) -> str:
    """A hint ``' Did you mean ...?'`` with the nearest known name, or an empty string."""
    word = value if isinstance(value, str) else shown(value)
    nearest = difflib.get_close_matches(word[:LONGEST_SHOWN], list(known), n=1, cutoff=0.5)
    return f" Did you mean {nearest[0]!r}?" if nearest else ""


def shown(value: object) -> str:
    """A value as Python writes it, cut where it is long, for a message."""
    try:
        text = repr(value)
    except (ValueError, RecursionError):  # a whole number of thousands of digits, a list of lists of lists ...
        return f"a {type(value).__name__} that is too long to show"
    return text if len(text) <= LONGEST_SHOWN else f"{text[:LONGEST_SHOWN]}..."


def visible(text: str) -> str:
    """The text with control characters written as escapes, so that it cannot steer a terminal; newlines too."""
    return "".join(char if char.isprintable() else char.encode("unicode_escape").decode() for char in text)


def is_disk_full(error: Exception) -> bool:
    """Whether there was no room to write; told by its words, as not every library raises an OSError."""
    return any(os.strerror(code) in str(error) for code in (ENOSPC, EDQUOT))
