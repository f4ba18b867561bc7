"""What keeps a Ray to its owner: a folder and a token that nobody else reads, and listeners on loopback alone.

Ray runs whatever code a client sends it. So a Ray of ours demands a token that only the owner of the run can read, also
on this machine, and binds every port to 127.0.0.1; a cluster that is joined must demand a token too.
"""

import fcntl
import os
import secrets
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from ray._private import ray_constants
from ray._raylet import AuthenticationTokenLoader, Config
from ray.exceptions import AuthenticationError

from cconv.errors import ConfigError

PREFIX = "cconv-"
LONGEST_SOCKET = 107  # bytes of a socket's path that Linux takes
SESSION = "/ray/session_2026-01-01_00-00-00_000000_0000000/sockets/plasma_store"  # the longest that Ray appends
TOKEN = "token"
LOCK = "lock"
TOKEN_VARIABLES = ("RAY_AUTH_TOKEN", "RAY_AUTH_TOKEN_PATH")


@contextmanager
def private_folder() -> Iterator[Path]:
    """A short folder for Ray's files and the token of this run, for its owner's eyes; it goes when the run ends.

    Folders that killed runs of the same user left behind go first.

    Raises:
        ConfigError: If no folder for temporary files is short enough and can be written to.
    """
    folder = _made_folder()
    try:
        with (folder / LOCK).open("w") as lock:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            yield folder
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def demand_tokens() -> None:
    """Make Ray, here and in the processes that it starts, talk to nobody without a token, whenever it was imported."""
    os.environ["RAY_AUTH_MODE"] = "token"
    Config.initialize("")


@contextmanager
def token_of_this_run(folder: Path) -> Iterator[None]:
    """Make the token that Ray demands a fresh random one, which stands in `folder`.

    The environment names the file and never holds the token, as programs print environments into logs.
    """
    path = folder / TOKEN
    with os.fdopen(os.open(path, os.O_CREAT | os.O_EXCL | os.O_WRONLY, 0o600), "w") as file:
        file.write(secrets.token_hex(32))
    before = {name: os.environ.pop(name, None) for name in TOKEN_VARIABLES}
    os.environ["RAY_AUTH_TOKEN_PATH"] = str(path)
    AuthenticationTokenLoader.instance().reset_cache()
    try:
        yield
    finally:
        for name, value in before.items():
            os.environ.pop(name, None)
            if value is not None:
                os.environ[name] = value
        AuthenticationTokenLoader.instance().reset_cache()


@contextmanager
def on_loopback_alone() -> Iterator[None]:
    """Let Ray's processes listen on 127.0.0.1 only, which Ray itself does where it supports no clusters."""
    before = ray_constants.ENABLE_RAY_CLUSTER
    ray_constants.ENABLE_RAY_CLUSTER = False
    try:
        yield
    finally:
        ray_constants.ENABLE_RAY_CLUSTER = before


def check_token_of_cluster(address: str) -> None:
    """Raise `ConfigError` unless the user has a token for the cluster at `address`."""
    if not _has_token():
        raise ConfigError(
            f"--address {address}: no token for this cluster, and one without a token runs anybody's code; make one "
            "with `ray get-auth-token --generate`, copy ~/.ray/auth_token to every node (or name the file in "
            "RAY_AUTH_TOKEN_PATH), start the nodes with RAY_AUTH_MODE=token."
        )


def _has_token() -> bool:
    AuthenticationTokenLoader.instance().reset_cache()
    try:
        return AuthenticationTokenLoader.instance().has_token(ignore_auth_mode=True)
    except AuthenticationError:  # the file that the environment names is not there or empty
        return False


def _made_folder() -> Path:
    """A folder of mode 0700 in the first place for temporary files where sockets of Ray have names short enough."""
    reasons = []
    for place in dict.fromkeys((tempfile.gettempdir(), "/tmp", "/var/tmp")):
        room = LONGEST_SOCKET - len(os.fsencode(f"{place}/{PREFIX}12345678{SESSION}"))
        if room < 0:
            reasons.append(f"{place} is {-room} bytes too long")
            continue
        try:
            _remove_left_behind(Path(place))
            return Path(tempfile.mkdtemp(prefix=PREFIX, dir=place))
        except OSError as error:
            reasons.append(f"{place}: {error.strerror}")
    raise ConfigError(
        f"no place for Ray's temporary files ({'; '.join(reasons)}); set TMPDIR to a short folder that you can write "
        "to."
    )


def _remove_left_behind(place: Path) -> None:
    """Delete the folders of runs that were killed: those of this user whose lock nobody holds."""
    for folder in place.glob(f"{PREFIX}????????"):
        try:
            if folder.is_symlink() or folder.stat().st_uid != os.getuid():
                continue
            with (folder / LOCK).open() as lock:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
                shutil.rmtree(folder, ignore_errors=True)
        except OSError:  # in use, without a lock yet, or already gone
            continue
