"""Nobody but the owner of a run reaches its Ray: listeners on loopback alone, a token that only the owner reads."""

import os
import stat
import subprocess
import sys
from pathlib import Path

import psutil
import pytest
import ray
from conftest import SMOKE
from processes import PATIENCE, tree

from cconv.errors import ConfigError
from cconv.study.running.private_ray import check_token_of_cluster
from cconv.study.running.ray_pool import ray_pool
from cconv.study.studies import load_study

LOOPBACK = ("127.0.0.1", "::1", "::ffff:127.0.0.1")
NOBODY = 65534
JOIN = """
import os, sys
from ray._raylet import GcsClient
address, user = sys.argv[1], int(sys.argv[2])
os.setgroups([]) if user != os.getuid() else None
os.setgid(user), os.setuid(user)
if len(sys.argv) > 3:
    os.environ["RAY_AUTH_TOKEN_PATH"] = sys.argv[3]
try:
    GcsClient(address=address).internal_kv_put(b"joined", b"yes", True, b"test")
except BaseException as error:
    print("refused", type(error).__name__, str(error))
else:
    print("joined")
"""


@pytest.fixture(scope="module")
def running(tmp_path_factory):
    """A Ray as a study starts it: address of its control service, and the file of its token."""
    with ray_pool(load_study(SMOKE, ["search.concurrency=1"]), None, tmp_path_factory.mktemp("ray")):
        ray.get(ray.remote(lambda: 0).remote())  # a worker is there, and listens
        yield ray.get_runtime_context().gcs_address, Path(os.environ["RAY_AUTH_TOKEN_PATH"])


def join(address, *arguments, user=None, **environment):
    """What a process of some user hears that tries to write to the running Ray."""
    known = {name: value for name, value in os.environ.items() if not name.startswith("RAY_")}
    command = [sys.executable, "-c", JOIN, address, str(os.getuid() if user is None else user), *map(str, arguments)]
    environment = known | {"HOME": "/nonexistent"} | environment
    run = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=PATIENCE)
    return run.stdout


@pytest.mark.slow
def test_everything_listens_on_loopback_alone(running):
    processes = tree(os.getpid())
    listeners = {
        (process.name(), connection.laddr.ip)
        for process in processes
        for connection in process.net_connections("inet")
        if connection.status == psutil.CONN_LISTEN
    }
    assert {"gcs_server", "raylet"} <= {name for name, _ in listeners}
    assert {ip for _, ip in listeners} <= set(LOOPBACK)


@pytest.mark.slow
def test_only_the_owner_reads_the_token_and_no_command_line_or_environment_holds_it(running):
    _, path = running
    token = path.read_text()
    assert len(token) >= 32
    assert stat.S_IMODE(path.stat().st_mode) == 0o600
    assert stat.S_IMODE(path.parent.stat().st_mode) == 0o700
    for process in tree(os.getpid()):
        assert token not in " ".join(process.cmdline())
        assert token not in process.environ().values()


@pytest.mark.slow
@pytest.mark.parametrize(
    "environment",
    [{"RAY_AUTH_MODE": "disabled"}, {"RAY_AUTH_MODE": "token", "RAY_AUTH_TOKEN": "0" * 64}],
    ids=["no token", "a wrong one"],
)
def test_who_has_no_token_or_a_wrong_one_cannot_join(running, environment):
    assert join(running[0], **environment).startswith("refused AuthenticationError")


@pytest.mark.slow
def test_who_has_the_token_can_join(running):
    """Otherwise the tests beside this one would pass for another reason than the token."""
    address, path = running
    assert join(address, RAY_AUTH_MODE="token", RAY_AUTH_TOKEN_PATH=str(path)) == "joined\n"


@pytest.mark.slow
@pytest.mark.skipif(os.getuid() != 0, reason="only root can act as another user")
def test_another_user_can_neither_read_the_token_nor_join(running):
    address, path = running
    reading = subprocess.run(["cat", path], user=NOBODY, capture_output=True, text=True)
    assert (reading.returncode != 0, reading.stdout) == (True, "")
    assert "joined" not in join(address, path, user=NOBODY, RAY_AUTH_MODE="token")
    assert join(address, user=NOBODY, RAY_AUTH_MODE="disabled").startswith("refused AuthenticationError")
    assert join(address, user=NOBODY, RAY_AUTH_MODE="token", RAY_AUTH_TOKEN=path.read_text()) == "joined\n"


@pytest.fixture
def token_file(tmp_path, monkeypatch):
    """The file of a cluster's token, where Ray looks for it if the environment names none."""
    monkeypatch.delenv("RAY_AUTH_TOKEN", raising=False)
    monkeypatch.delenv("RAY_AUTH_TOKEN_PATH", raising=False)
    monkeypatch.setenv("HOME", str(tmp_path))
    path = tmp_path / ".ray" / "auth_token"
    path.parent.mkdir()
    path.write_text("a" * 64)
    path.chmod(0o600)
    return path


@pytest.mark.parametrize("mode", [0o640, 0o620, 0o604, 0o644, 0o777])
def test_a_token_of_a_cluster_that_others_can_read_or_write_is_one_line_that_says_what_to_do(token_file, mode):
    token_file.chmod(mode)
    refused = pytest.raises(ConfigError, match=f"--address there:1: .* open to other users.*`chmod 600 {token_file}`")
    with refused as caught:
        check_token_of_cluster("there:1")
    assert "\n" not in str(caught.value)


@pytest.mark.skipif(os.getuid() != 0, reason="only root can give files away")
def test_a_token_of_a_cluster_that_belongs_to_another_user_is_one_line_that_says_what_to_do(token_file):
    os.chown(token_file, NOBODY, NOBODY)
    refused = pytest.raises(ConfigError, match=f"belongs to another user.*`chown .* && chmod 600 {token_file}`")
    with refused as caught:
        check_token_of_cluster("there:1")
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("mode", [0o600, 0o400])
def test_a_token_of_a_cluster_for_its_owner_alone_is_taken_from_where_ray_finds_it(
    token_file, tmp_path, monkeypatch, mode
):
    token_file.chmod(mode)
    check_token_of_cluster("there:1")
    elsewhere = token_file.rename(tmp_path / "elsewhere")
    with pytest.raises(ConfigError, match="no token for this cluster"):
        check_token_of_cluster("there:1")
    monkeypatch.setenv("RAY_AUTH_TOKEN_PATH", str(elsewhere))
    check_token_of_cluster("there:1")


def test_a_token_in_the_environment_needs_no_file(token_file, monkeypatch):
    token_file.chmod(0o644)
    monkeypatch.setenv("RAY_AUTH_TOKEN", "a" * 64)
    check_token_of_cluster("there:1")
