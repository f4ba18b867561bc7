"""Protection of Ray from other users: a token that only the owner of the run can read, and ports on loopback only.

Ray executes any code that a client sends. So a private Ray demands the token, also from clients on this machine, and
binds every port to 127.0.0.1. A cluster that a study joins must demand a token too.
"""

import os
import secrets
import stat
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path

import psutil
from ray._private import ray_constants
from ray._raylet import AuthenticationTokenLoader, Config  # type: ignore[attr-defined]  # compiled, without stubs
from ray.exceptions import AuthenticationError

from cconv.errors import ConfigError

TOKEN = "token"
TOKEN_VARIABLES = ("RAY_AUTH_TOKEN", "RAY_AUTH_TOKEN_PATH")


def demand_tokens() -> None:
    """Make Ray refuse everyone without a token, here and in the processes that it starts, even if already imported."""
    os.environ["RAY_AUTH_MODE"] = "token"
    Config.initialize("")


@contextmanager
def token_of_this_run(folder: Path) -> Iterator[None]:
    """Write a new random token to `folder` and make Ray demand it.

    The environment names the file but does not hold the token, because programs print environments to logs.
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
    """Let Ray's processes listen on 127.0.0.1 only, as Ray does on systems on which it supports no clusters."""
    return _constant_of_ray("ENABLE_RAY_CLUSTER", False)


def asking_once() -> AbstractContextManager[None]:
    """Let Ray try only once, not twenty times, to join a cluster that refuses it; each try takes 40 seconds."""
    return _constant_of_ray("NUM_REDIS_GET_RETRIES", 1)


@contextmanager
def _constant_of_ray(name: str, value: int) -> Iterator[None]:
    before = getattr(ray_constants, name)
    setattr(ray_constants, name, value)
    try:
        yield
    finally:
        setattr(ray_constants, name, before)


def kill_processes_of(folder: Path) -> None:
    """Kill the processes that Ray left in a private folder when it failed to start."""
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
    except AuthenticationError:  # the file that the environment names is missing or empty
        return False


def _token_file() -> Path | None:
    """Return the file that Ray reads the token from; None if the environment holds the token itself."""
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
