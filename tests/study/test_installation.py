"""`cconv doctor` finds what is wrong with an installation and says what to do; a check that fails stops no other."""

import json
import os
import shutil
from contextlib import contextmanager
from types import SimpleNamespace

import pytest

from cconv.errors import ConfigError
from cconv.study import installation
from cconv.study.installation import examine


@pytest.fixture(autouse=True)
def ray_starts(monkeypatch):
    """Ray need not start in each of these tests: studies of other tests start it."""

    @contextmanager
    def starts(cores):
        yield

    monkeypatch.setattr(installation, "private_ray", starts)


def examined(folder):
    return {checked.name: checked for checked in examine(folder)}


def test_this_installation_has_no_problem(tmp_path, cconv):
    found = examined(tmp_path)
    assert {checked.state for checked in found.values()} <= {"ok", "note", "warning"}
    assert {"Python", "packages", "disk", "temporary folder", "compiled loops", "Ray"} <= set(found)
    code, printed, _ = cconv("doctor", "--json")
    assert code == 0
    assert [each["name"] for each in json.loads(printed)] == list(found)


def test_packages_that_are_missing_or_too_old_are_named(tmp_path, monkeypatch):
    true = installation.version

    def version(name):
        if name == "zstandard":
            raise installation.PackageNotFoundError(name)
        return "0.0.1" if name == "h5py" else true(name)

    monkeypatch.setattr(installation, "version", version)
    found = examined(tmp_path)["packages"]
    assert found.state == "problem"
    assert "h5py is 0.0.1, not >=" in found.found
    assert "zstandard is missing" in found.found


def test_a_disk_without_room_is_a_warning_and_a_folder_that_is_not_writable_a_problem(tmp_path, monkeypatch):
    monkeypatch.setattr(shutil, "disk_usage", lambda folder: SimpleNamespace(free=10**8))
    full = examined(tmp_path)["disk"]
    assert (full.state, full.found) == ("warning", f"100 MB free in {tmp_path}")
    assert examined(tmp_path / "none")["disk"].state == "problem"


def test_a_ray_that_does_not_start_is_a_problem_with_a_way_out(tmp_path, monkeypatch, cconv):
    @contextmanager
    def fails(cores):
        raise ConfigError("Ray does not start on this machine (no ports).")
        yield

    monkeypatch.setattr(installation, "private_ray", fails)
    found = examined(tmp_path)["Ray"]
    assert (found.state, found.found) == ("problem", "Ray does not start on this machine (no ports)")
    assert "--serial" in found.advice
    code, printed, _ = cconv("doctor")
    assert code == 1
    assert "problem Ray: Ray does not start" in " ".join(printed.split())


def test_a_check_that_breaks_is_a_problem_and_the_others_go_on(tmp_path, monkeypatch):
    monkeypatch.setattr(installation.psutil, "virtual_memory", lambda: 1 / 0)
    found = examined(tmp_path)
    assert found["memory"].state == "problem"
    assert "ZeroDivisionError" in found["memory"].found
    assert found["disk"].state in ("ok", "warning")


def test_more_threads_than_cores_are_a_warning(tmp_path, monkeypatch):
    monkeypatch.setattr(installation.torch, "get_num_threads", lambda: 10_000)
    found = examined(tmp_path)["cores"]
    assert found.state == "warning"
    assert "set OMP_NUM_THREADS" in found.advice


@pytest.mark.skipif(os.name != "posix", reason="folders without write permission")
def test_compiled_code_that_cannot_be_kept_is_a_warning(tmp_path, monkeypatch):
    monkeypatch.setattr(installation.os, "access", lambda path, mode: False)
    assert examined(tmp_path)["compiled loops"].state == "warning"
