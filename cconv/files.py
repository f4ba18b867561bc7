"""Text files: read whole or refused in one line, before they cost memory or time; written whole or not at all."""

import json
import os
import re
import stat
import tomllib
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any, NoReturn

from filelock import FileLock

from cconv.errors import CConvError, ConfigError, DataError, shown

LARGEST_FILE = 2**26  # bytes of a JSON file
LARGEST_SETTINGS = 2**20  # bytes of a TOML file
DEEPEST = 32  # tables and arrays inside each other

_KEY_PART = r"(?:[A-Za-z0-9_-]+|\"[^\"\n]*\"|'[^'\n]*')[ \t]*"
_LONG_KEY = re.compile(rf"(?<![A-Za-z0-9_-]){_KEY_PART}(?:\.[ \t]*{_KEY_PART}){{{DEEPEST}}}")


def read_text(path: Path | str, largest: int = LARGEST_FILE, error: type[CConvError] = DataError) -> str:
    """Content of a regular UTF-8 file.

    Args:
        path: The file.
        largest: Bytes that it may have.
        error: Kind of error to raise.

    Raises:
        CConvError: Of the kind `error`, if there is no such file, or it is no regular one, too large or no text.
    """
    path = Path(path)
    try:
        status = path.stat()
        if not stat.S_ISREG(status.st_mode):
            raise error(f"{path}: no regular file; give the path of a file.")
        if status.st_size > largest:
            raise error(f"{path}: {status.st_size} bytes, and such a file has at most {largest}; give another one.")
        return path.read_text(encoding="utf-8")
    except (FileNotFoundError, NotADirectoryError) as problem:
        raise error(f"{path}: no such file; check the path.") from problem
    except UnicodeDecodeError as problem:
        raise error(f"{path}: not a text in UTF-8 ({problem.reason} at byte {problem.start}).") from problem
    except OSError as problem:
        raise error(f"{path}: cannot be read ({problem.strerror}).") from problem


def read_json(path: Path | str, largest: int = LARGEST_FILE, error: type[CConvError] = DataError) -> Any:
    """Content of a JSON file; arguments and errors as of `read_text`."""
    text = read_text(path, largest, error)
    try:
        return parse_json(text)
    except ValueError as problem:
        raise error(f"{path}: not JSON ({problem}); restore the file or make it again.") from problem


def parse_json(text: str) -> Any:
    """Value of a JSON text without NaN, infinity and repeated keys, at most `DEEPEST` deep.

    Raises:
        ValueError: If it is none.
    """
    return _parsed(text, partial(json.loads, parse_constant=_refuse_constant, object_pairs_hook=_without_repeats))


def read_toml(path: Path | str) -> dict:
    """Content of a TOML file.

    Raises:
        ConfigError: If the file cannot be read or is not TOML.
    """
    text = read_text(path, LARGEST_SETTINGS, ConfigError)
    try:
        return parse_toml(text)
    except ValueError as problem:
        raise ConfigError(f"{path}: not a TOML file ({problem}); mend that line.") from problem


def parse_toml(text: str) -> dict:
    """Value of a TOML text, at most `DEEPEST` deep; longer keys are refused before they are parsed.

    Raises:
        ValueError: If it is none.
    """
    if _LONG_KEY.search(text):  # tomllib takes memory that grows with the square of their length
        raise ValueError(f"a key has more than {DEEPEST} parts")
    return _parsed(text, tomllib.loads)


def _parsed(text: str, parse: Callable[[str], Any]) -> Any:
    """What `parse` makes of a text, unless it is too deep."""
    try:
        value = parse(text)
    except RecursionError:
        depth = DEEPEST + 1
    else:
        depth = _depth(value)
    if depth > DEEPEST:
        raise ValueError(f"more than {DEEPEST} tables or arrays inside each other")
    return value


def _refuse_constant(name: str) -> NoReturn:
    raise ValueError(f"{name} is no number of JSON")


def _without_repeats(pairs: list[tuple]) -> dict:
    table = dict(pairs)
    if len(table) < len(pairs):
        twice = Counter(name for name, _ in pairs).most_common(1)[0][0]
        raise ValueError(f"the key {shown(twice)} stands there twice")
    return table


def _depth(value: object) -> int:
    """Tables and arrays inside each other; level by level, as Python's own stack ends at some hundred."""
    depth, level = 0, [value]
    while level := [each for each in level if isinstance(each, dict | list)]:
        level = [inner for each in level for inner in (each.values() if isinstance(each, dict) else each)]
        depth += 1
    return depth


def write_json(path: Path, value: Any) -> None:
    """Write JSON under a temporary name, then rename, so that a reader never finds half a file."""
    write_text(path, json.dumps(value, indent=2, allow_nan=False) + "\n")


def write_text(path: Path, text: str) -> None:
    """Write a file under a temporary name, then rename it."""
    with replacing(path) as part:
        part.write_text(text)


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """A temporary name for a file beside `path`, renamed to it when all is written, removed if anything fails."""
    path.parent.mkdir(parents=True, exist_ok=True)
    part = path.with_name(f".{path.stem}-{os.getpid()}{path.suffix}")
    try:
        yield part
        part.replace(path)
    finally:
        part.unlink(missing_ok=True)


@contextmanager
def held(path: Path) -> Iterator[None]:
    """Hold a lock file alone; the system lets go of it even if the process is killed.

    Raises:
        filelock.Timeout: If another process holds it.
        OSError: If it cannot be locked.
    """
    lock = FileLock(path, fallback_to_soft=False)  # which a kill would leave behind
    lock.acquire(blocking=False)
    try:
        yield
    finally:
        lock.release()
