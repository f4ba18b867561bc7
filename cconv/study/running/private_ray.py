"""What keeps a Ray to its owner: a folder and a token that nobody else reads, and listeners on loopback alone.

Ray runs whatever code a client sends it. So a Ray of ours demands a token that only the owner of the run can read, also
on this machine, and binds every port to 127.0.0.1; a cluster that is joined must demand a token too.
"""

import fcntl
import os
import secrets
import shutil
import stat
import tempfile
from collections.abc import Iterator
from contextlib import AbstractContextManager, ExitStack, contextmanager
from pathlib import Path

import psutil
from ray._private import ray_constants
from ray._raylet import AuthenticationTokenLoader, Config
from ray.exceptions import AuthenticationError

from cconv.errors import ConfigError

PREFIX = "cconv-"
LONGEST_SOCKET = 107  # bytes of a socket's path that Linux takes
SESSION = "/ray/session_2026-01-01_00-00-00_000000_0000000/sockets/plasma_store"  # the longest that Ray appends
TOKEN = "token"
TOKEN_VARIABLES = ("RAY_AUTH_TOKEN", "RAY_AUTH_TOKEN_PATH")


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


def on_loopback_alone() -> AbstractContextManager[None]:
    """Let Ray's processes listen on 127.0.0.1 only, which Ray itself does where it supports no clusters."""
    return _constant_of_ray("ENABLE_RAY_CLUSTER", False)


def asking_once() -> AbstractContextManager[None]:
    """Let Ray ask a cluster that does not let it in once, not twenty times; each takes 40 seconds."""
    return _constant_of_ray("NUM_REDIS_GET_RETRIES", 1)


@contextmanager
def _constant_of_ray(name: str, value) -> Iterator[None]:
    before = getattr(ray_constants, name)
    setattr(ray_constants, name, value)
    try:
        yield
    finally:
        setattr(ray_constants, name, before)


def kill_processes_of(folder: Path) -> None:
    """End what Ray started in a private folder and left there when it did not come up."""
    for process in psutil.Process().children(recursive=True):
        try:
            if str(folder) in " ".join(process.cmdline()):
                process.kill()
        except psutil.NoSuchProcess:
            continue


def check_token_of_cluster(address: str) -> None:
    """Raise `ConfigError` unless the user has a token for the cluster at `address` that nobody else can read."""
    if not _has_token():
        raise ConfigError(
            f"--address {address}: no token for this cluster, and one without a token runs anybody's code; make one "
            "with `(umask 077; ray get-auth-token --generate)`, copy ~/.ray/auth_token to every node (or name it in "
            "RAY_AUTH_TOKEN_PATH), start the nodes with RAY_AUTH_MODE=token."
        )
    path = _token_file()
    if path is not None:
        _check_only_owner_reads(path, address)


def _has_token() -> bool:
    AuthenticationTokenLoader.instance().reset_cache()
    try:
        return AuthenticationTokenLoader.instance().has_token(ignore_auth_mode=True)
    except AuthenticationError:  # the file that the environment names is not there or empty
        return False


def _token_file() -> Path | None:
    """The file that Ray reads the token from; None where the environment holds the token itself."""
    if os.environ.get("RAY_AUTH_TOKEN"):
        return None
    return Path(os.environ.get("RAY_AUTH_TOKEN_PATH") or Path.home() / ".ray" / "auth_token")


def _check_only_owner_reads(path: Path, address: str) -> None:
    status = path.stat()
    is_ours = status.st_uid == os.getuid()
    if is_ours and not status.st_mode & (stat.S_IRWXG | stat.S_IRWXO):
        return
    fault, cure = "is open to other users", f"chmod 600 {path}"
    if not is_ours:
        fault, cure = "belongs to another user", f"chown $USER {path} && {cure}"
    raise ConfigError(f"--address {address}: {path} {fault}, and who reads the token runs code as you; `{cure}`.")


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
