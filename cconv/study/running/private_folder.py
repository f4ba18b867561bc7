"""Private folders of short names for the files of Ray; also runs without Ray delete those of killed runs."""

import os
import shutil
import sys
import tempfile
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

from cconv.errors import ConfigError

PREFIX = "cconv-"
LONGEST_SOCKET = 103 if sys.platform == "darwin" else 107  # bytes of a socket's path that the system takes
SESSION = "/ray/session_2026-01-01_00-00-00_000000_0000000/sockets/plasma_store"  # the longest that Ray appends


@contextmanager
def private_folder() -> Iterator[Path]:
    """Make a folder of short name that only its owner can read, for Ray's files and token, and delete it in the end.

    Raises:
        ConfigError: If no folder for temporary files is short enough and can be written to.
    """
    with ExitStack() as stack:
        folder = _made_folder()
        while not stack.enter_context(_locked(folder)):  # another run deleted it before it was locked
            folder = _made_folder()
        stack.callback(shutil.rmtree, folder, ignore_errors=True)
        yield folder


def remove_left_behind(folder: Path) -> None:
    """Delete the files of Ray that killed runs left: those of this run in `folder`, and this user's private folders."""
    shutil.rmtree(folder, ignore_errors=True)
    remove_private_folders()


def remove_private_folders() -> None:
    """Delete the private folders of killed runs: those of this user that no process has locked."""
    for folder in (each for place in _places() for each in Path(place).glob(f"{PREFIX}????????")):
        try:
            if folder.is_symlink() or not folder.is_dir() or folder.stat().st_uid != os.getuid():
                continue
            with _locked(folder) as is_ours:
                if is_ours:
                    shutil.rmtree(folder, ignore_errors=True)
        except OSError:  # already gone
            continue


@contextmanager
def _locked(folder: Path) -> Iterator[bool]:
    """Lock a folder; yield False if another process has locked or deleted it. A killed process loses its lock."""
    try:
        descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW)
    except FileNotFoundError:
        yield False
        return
    try:
        yield _lock(descriptor) and folder.exists()
    finally:
        os.close(descriptor)


def _lock(descriptor: int) -> bool:
    import fcntl  # which Unix has alone

    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    return True


def _made_folder() -> Path:
    """Make a folder of mode 0700 in the first place for temporary files in which paths of sockets are short enough."""
    reasons = []
    for place in _places():
        room = LONGEST_SOCKET - len(os.fsencode(f"{place}/{PREFIX}12345678{SESSION}"))
        if room < 0:
            reasons.append(f"{place} is {-room} bytes too long")
            continue
        try:
            return Path(tempfile.mkdtemp(prefix=PREFIX, dir=place))
        except OSError as error:
            reasons.append(f"{place}: {error.strerror}")
    raise ConfigError(
        f"no place for Ray's temporary files ({'; '.join(reasons)}); set TMPDIR to a short folder that you can write "
        "to."
    )


def _places() -> list[str]:
    """List the folders for temporary files, the one that the user wants first."""
    return list(dict.fromkeys((tempfile.gettempdir(), "/tmp", "/var/tmp")))
