"""Short folders for the files of a run's Ray, for its owner's eyes; known without Ray, as any run clears them away."""

import fcntl
import os
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

from cconv.errors import ConfigError

PREFIX = "cconv-"
LONGEST_SOCKET = 107  # bytes of a socket's path that Linux takes
SESSION = "/ray/session_2026-01-01_00-00-00_000000_0000000/sockets/plasma_store"  # the longest that Ray appends


@contextmanager
def private_folder() -> Iterator[Path]:
    """A short folder for Ray's files and the token of this run, for its owner's eyes; it goes when the run ends.

    Raises:
        ConfigError: If no folder for temporary files is short enough and can be written to.
    """
    with ExitStack() as stack:
        folder = _made_folder()
        while not stack.enter_context(_locked(folder)):  # another run took it for left behind before it was locked
            folder = _made_folder()
        stack.callback(shutil.rmtree, folder, ignore_errors=True)
        yield folder


def remove_left_behind(folder: Path) -> None:
    """Delete what killed runs left of Ray: its files of the run in `folder`, and private folders of the same user."""
    shutil.rmtree(folder, ignore_errors=True)
    remove_private_folders()


def remove_private_folders() -> None:
    """Delete the private folders of runs that were killed: those of this user that no process has locked."""
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
    """Hold a folder for this process alone, however that ends; False if another holds it or has deleted it."""
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
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    return True


def _made_folder() -> Path:
    """A folder of mode 0700 in the first place for temporary files where sockets of Ray have names short enough."""
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
    """Folders for temporary files, the one that the user wants first."""
    return list(dict.fromkeys((tempfile.gettempdir(), "/tmp", "/var/tmp")))
