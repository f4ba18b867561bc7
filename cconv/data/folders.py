"""Atomic writing of files and folders: they appear complete or not at all."""

import os
import re
import shutil
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path

import psutil

from cconv.data.limits import readable_size
from cconv.errors import ConfigError
from cconv.files import replacing


@contextmanager
def whole_file(file: Path) -> Iterator[Path]:
    """Give a temporary name beside `file`, which is renamed to it when complete and removed if anything fails.

    Raises:
        ConfigError: If the file cannot be written.
    """
    try:
        with replacing(file) as part:
            yield part
    except OSError as error:
        raise ConfigError(f"{file}: cannot be written ({error.strerror or error}); name another file.") from error


@contextmanager
def whole_folder(folder: Path, files: Iterable[str], overwrite: bool) -> Iterator[Path]:
    """Give a temporary folder beside `folder`, which is renamed to it when complete and removed if anything fails.

    Args:
        folder: Folder of the files; it may exist if it is empty.
        files: Names that will be written. With `overwrite` a folder with nothing else in it is replaced.
        overwrite: Whether an older data set may be replaced.

    Raises:
        ConfigError: If the folder exists and must not be replaced, or cannot be written.
    """
    folder = folder.absolute()
    check_free(folder, files, overwrite)
    partial = folder.with_name(f".{folder.name}.{os.getpid()}.partial")
    try:
        partial.mkdir(parents=True)
        yield partial
        _replace(folder, partial)
        _remove_left_behind(folder)
    except OSError as error:
        reason = " ".join(str(error.strerror or error).split())  # HDF5 errors have several lines
        raise ConfigError(f"{folder}: cannot be written ({reason}); name another folder.") from error
    finally:
        shutil.rmtree(partial, ignore_errors=True)


def check_free(folder: Path, files: Iterable[str], overwrite: bool) -> None:
    """Raise `ConfigError` unless `folder` is empty, missing, or holds nothing but `files` that may be replaced."""
    files = set(files)
    if folder.exists() and not folder.is_dir():
        raise ConfigError(f"{folder}: is a file; name a folder to write to.")
    present = {entry.name for entry in folder.iterdir()} if folder.exists() else set()
    if present - files and overwrite:
        others = ", ".join(sorted(present - files)[:3])
        raise ConfigError(f"{folder}: holds other files than are to be replaced ({others}); name another folder.")
    if present and not overwrite:
        raise ConfigError(f"{folder}: exists and is not empty; name another folder or overwrite it.")


def check_room(folder: Path, size: int) -> None:
    """Raise `ConfigError` unless the disk of a folder, which may not exist yet, has room for at least so many bytes."""
    place = next(each for each in (folder.absolute(), *folder.absolute().parents) if each.exists())
    free = shutil.disk_usage(place).free
    if size > free:
        raise ConfigError(
            f"{folder}: at least {readable_size(size)} would be written, and {readable_size(free)} are free there; "
            "make room, name a folder on a larger disk, or ask for fewer frames."
        )


def _remove_left_behind(folder: Path) -> None:
    """Delete the temporary folders that killed processes left for the same folder."""
    left = re.compile(rf"\.{re.escape(folder.name)}\.(\d+)\.partial(\.old)?")
    for path in folder.parent.iterdir():
        match = left.fullmatch(path.name)
        if match and not psutil.pid_exists(int(match[1])):
            shutil.rmtree(path, ignore_errors=True)


def _replace(folder: Path, new: Path) -> None:
    old = folder.with_name(f"{new.name}.old")
    if folder.exists():
        folder.rename(old)
    new.rename(folder)
    shutil.rmtree(old, ignore_errors=True)
