"""Fixtures that all tests share, made once for all workers of pytest-xdist."""

import fcntl
import importlib.util
import os
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import jaxtyping
import pytest
import torch
from processes import PATIENCE

from cconv.cli import main

SCRIPT = Path(sys.executable).parent / "cconv"
BENCHMARKS = Path(__file__).parents[1] / "experiments" / "benchmarks"
SMOKE = Path(__file__).parents[1] / "experiments" / "smoke.toml"
IS_WORKER = "PYTEST_XDIST_WORKER" in os.environ
WITHOUT_RAY = "import sys; sys.modules['ray'] = None; from cconv.cli import main; main()"

if IS_WORKER:  # the workers themselves use the cores
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    torch.set_num_threads(1)


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items):
    """What looks at a whole study is no fast test."""
    for item in items:
        if "finished_run" in item.fixturenames:
            item.add_marker("integration")


def made_once(factory: pytest.TempPathFactory, name: str, make: Callable[[Path], None]) -> Path:
    """A folder that the first of all workers to ask for it makes, while the others wait."""
    base = factory.getbasetemp().parent if IS_WORKER else factory.getbasetemp()
    folder, made = base / name, base / f"{name}.made"
    with (base / f"{name}.lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not made.exists():
            shutil.rmtree(folder, ignore_errors=True)  # what a worker that failed left
            make(folder)
            made.touch()
    return folder


@pytest.fixture
def generator():
    """A seeded source of random numbers; a test's draws do not depend on other tests."""
    return torch.Generator().manual_seed(0)


@pytest.fixture
def unchecked():
    """Annotations are not checked, as checks do not know the symbols that stand for any number of particles."""
    jaxtyping.config.update("jaxtyping_disable", True)
    yield
    jaxtyping.config.update("jaxtyping_disable", False)


@pytest.fixture
def restored_threads():
    """Give torch the number of threads back that it had before a test."""
    threads = torch.get_num_threads()
    yield
    torch.set_num_threads(threads)


@pytest.fixture
def benchmark_script(monkeypatch):
    """Load a script of experiments/benchmarks as a module, given its name."""

    def load(name):
        spec = importlib.util.spec_from_file_location(f"{name}_benchmark", BENCHMARKS / f"{name}.py")
        module = importlib.util.module_from_spec(spec)
        monkeypatch.setitem(sys.modules, spec.name, module)
        spec.loader.exec_module(module)
        return module

    return load


@pytest.fixture
def solver_benchmark(benchmark_script):
    """The checks of the solver, with channel flows and their series solutions."""
    return benchmark_script("solver")


def run_main(*arguments):
    """Run `cconv` with arguments in this process; gives its exit status."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("sys.argv", ["cconv", *map(str, arguments)])
        with pytest.raises(SystemExit) as caught:
            main()
    return caught.value.code or 0


@pytest.fixture
def cconv(capfd):
    """Run `cconv` with arguments in this process; gives (exit status, stdout, stderr)."""

    def run(*arguments):
        code = run_main(*arguments)
        printed = capfd.readouterr()
        return code, printed.out, printed.err

    return run


def generate_vortices(folder, steps_per_frame, num_frames):
    """Generate a small Taylor–Green data set."""
    from cconv.data.generate import generate
    from cconv.scenes import scene_named

    settings = {"particle_spacing": 0.1, "steps_per_frame": steps_per_frame, "relaxation_steps": 50}
    scene = scene_named("taylor_green_2d", "small", **settings)
    generate(scene, folder, num_trajectories=4, num_frames=num_frames, workers=1)


@pytest.fixture(scope="session")
def flow_folder(tmp_path_factory):
    """A small Taylor–Green data set."""
    return made_once(tmp_path_factory, "flow", lambda folder: generate_vortices(folder, 5, 4))


@pytest.fixture(scope="session")
def steps_folder(tmp_path_factory):
    """A small Taylor–Green data set with frames enough for rollouts."""
    return made_once(tmp_path_factory, "steps", lambda folder: generate_vortices(folder, 10, 16))


@pytest.fixture(scope="session")
def finished_run(tmp_path_factory, flow_folder):
    """Run folder of a whole serial study of the smallest size, in a process of its own that cannot import Ray."""

    def make(folder):
        study = ["study", "run", SMOKE, "--serial", "--data", flow_folder, "--out", folder]
        command = [sys.executable, "-c", WITHOUT_RAY, *study]
        finished = subprocess.run(command, capture_output=True, text=True, timeout=PATIENCE)
        assert finished.returncode == 0, finished.stderr
        assert f"Report: {folder / 'report.html'}" in finished.stdout

    return made_once(tmp_path_factory, "smoke", make)
