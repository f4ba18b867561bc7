"""Fixtures that all tests share."""

import importlib.util
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from processes import PATIENCE

from cconv.cli import main

SCRIPT = Path(sys.executable).parent / "cconv"
BENCHMARKS = Path(__file__).parents[1] / "experiments" / "benchmarks"
SMOKE = Path(__file__).parents[1] / "experiments" / "smoke.toml"


@pytest.fixture
def generator():
    """A seeded source of random numbers; a test's draws do not depend on other tests."""
    return torch.Generator().manual_seed(0)


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


@pytest.fixture
def cconv(monkeypatch, capfd):
    """Run `cconv` with arguments in this process; gives (exit status, stdout, stderr)."""

    def run(*arguments):
        monkeypatch.setattr("sys.argv", ["cconv", *map(str, arguments)])
        with pytest.raises(SystemExit) as caught:
            main()
        printed = capfd.readouterr()
        return caught.value.code or 0, printed.out, printed.err

    return run


@pytest.fixture(scope="session")
def flow_folder(tmp_path_factory):
    """A small Taylor–Green data set."""
    from cconv.data.generate import generate
    from cconv.scenes import scene_named

    folder = tmp_path_factory.mktemp("data") / "flow"
    scene = scene_named("taylor_green_2d", "small", particle_spacing=0.1, steps_per_frame=5, relaxation_steps=50)
    generate(scene, folder, num_trajectories=4, num_frames=4, workers=1)
    return folder


@pytest.fixture(scope="session")
def finished_run(tmp_path_factory, flow_folder):
    """Run folder of a whole study of the smallest size, in a process of its own as Ray brings many more."""
    folder = tmp_path_factory.mktemp("runs") / "smoke"
    command = [SCRIPT, "study", "run", SMOKE, "--data", flow_folder, "--out", folder]
    finished = subprocess.run(command, capture_output=True, text=True, timeout=PATIENCE)
    assert finished.returncode == 0, finished.stderr
    assert f"Report: {folder / 'report.html'}" in finished.stdout
    return folder
