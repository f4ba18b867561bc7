"""The benchmark scripts run and write what they say, at sizes too small for their figures to mean anything."""

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import torch
from conftest import BENCHMARKS
from particle_files import record_frames, write_parts
from processes import PATIENCE

from cconv.evaluation.cost import ANALYTIC
from cconv.scenes import scene_named


def run(script, *arguments):
    """What a script of experiments/benchmarks prints."""
    command = [sys.executable, BENCHMARKS / f"{script}.py", "--smoke", *arguments]
    finished = subprocess.run(command, capture_output=True, text=True, timeout=2 * PATIENCE)
    assert finished.returncode == 0, finished.stderr
    return finished.stdout


@pytest.mark.slow
@pytest.mark.timeout(3 * PATIENCE)
def test_the_benchmark_of_layers_measures_compares_and_draws(tmp_path):
    printed = run("continuous_conv", "--out", tmp_path)
    for what in ("the same: ours / matrix products", "geometry of 100,000 edges / layer", "extra memory"):
        assert what in printed
    sweeps = pd.read_csv(tmp_path / "sweeps.csv")
    layers = sweeps[sweeps.sweep != "memory"]
    assert set(layers.sweep) == {"num_particles", "neighbors", "kernel_size", "channels", "threads"}
    assert {"ours", "general path", "matrix products"} <= set(layers.variant)
    assert (layers[["low", "ms", "high"]] > 0).all().all()
    assert layers.loc[layers.variant == "ours", "difference"].max() < 1e-5
    targets = pd.read_csv(tmp_path / "targets.csv")
    assert set(targets.quantity) == {"forward", "forward + backward", "preparation", "memory"}
    assert (tmp_path / "sweeps.png").is_file()


@pytest.mark.slow
@pytest.mark.timeout(3 * PATIENCE)
def test_the_benchmark_of_devices_measures_what_there_is_and_names_what_there_is_not(tmp_path):
    printed = run("devices", "--dims", "2", "--out", tmp_path)
    assert "density rate by a closed form" in printed
    assert torch.cuda.is_available() or printed.count("unmeasured here") >= 5
    written = json.loads((tmp_path / "devices.json").read_text())
    assert {row["what"] for row in written["rows"]} >= {"inspect", "fit", "evaluate", "rollout frame", "solver step"}
    assert all(row["cpu_seconds"] > 0 and row["peak_gb"] > 0 for row in written["rows"])
    assert (tmp_path / "devices.png").is_file()


@pytest.fixture
def dam_break(tmp_path):
    """A folder of records as of the dam break of DPI-Net, of a block of 64 particles."""
    ticks = 0.05 * np.arange(4, dtype="f4")
    block = np.stack(np.meshgrid(ticks, ticks, ticks), axis=-1).reshape(-1, 3)
    for number in range(4):
        frames = [frame | {"pos": block} for frame in record_frames(num_frames=21, num_particles=64)]
        write_parts(tmp_path / "data", f"sim_{number:04d}", frames)
    return tmp_path / "data"


@pytest.mark.slow
@pytest.mark.timeout(3 * PATIENCE)
def test_the_benchmark_of_predictions_compares_two_states_measures_growth_and_draws(dam_break, tmp_path):
    out = tmp_path / "out"
    run("inference", "--data", dam_break, "--before", Path(__file__).parents[1], "--out", out)
    results = json.loads((out / "inference.json").read_text())
    for row in results["compared"].values():
        assert {"before", "now", "before / now"} <= row.keys()
        assert 0 < row["before / now"]["low"] <= row["before / now"]["median"] <= row["before / now"]["high"]
    assert results["compared"]["published network"]["published now / this now"]["median"] == 1
    assert results["growth"].keys() == {"published network", "radial layer", "radial layer, no walls", ANALYTIC}
    assert len(results["costs"]) == len(results["estimates"]) == 6
    assert (out / "inference.png").is_file()


@pytest.mark.slow
@pytest.mark.timeout(3 * PATIENCE)
def test_the_benchmark_of_rollouts_measures_time_and_memory(tmp_path):
    printed = run("rollout", "--out", tmp_path)
    results = json.loads((tmp_path / "rollout.json").read_text())
    assert [row["num_particles"] for row in results["frames"]] == [400, 900]
    for row in results["frames"]:
        assert all(0 < row[time]["low"] <= row[time]["median"] <= row[time]["high"] for time in ("cpu_ms", "ms"))
        assert row["added_mb"] > 0
    assert results["growth"].keys() == {"cpu_ms exponent", "ms exponent", "kb per particle", "mb besides"}
    assert json.dumps(results["growth"]) in printed


@pytest.mark.slow
@pytest.mark.timeout(3 * PATIENCE)
def test_the_benchmark_of_joined_windows_compares_both_ways(flow_folder, tmp_path):
    run("joined", "--data", flow_folder, "--out", tmp_path)
    results = json.loads((tmp_path / "joined.json").read_text())
    (row,) = results["data"]
    for work in ("training_step", "validation"):
        assert all(row[work][way]["median"] > 0 for way in ("joined", "one by one", "one by one / joined"))


def test_growth_is_that_of_times_and_memory_that_are_known(benchmark_script):
    particles = [1000, 3000, 10_000]
    rows = [{"cpu_ms": {"median": 2 * n**1.1}, "ms": {"median": n**0.9}, "added_mb": 20 + 0.004 * n} for n in particles]
    found = benchmark_script("rollout").growth(particles, rows)
    assert list(found.values()) == pytest.approx([1.1, 0.9, 4.0, 20.0])


def test_what_is_rolled_out_is_periodic_vortices_at_rest_in_the_mean(benchmark_script):
    window, scene = benchmark_script("rollout").vortices(400, 6)
    displacements = window.displacements(scene.box, 6)
    assert window.positions.shape == (6, 400, 2)
    assert window.future.shape == (1, 400, 2)
    assert scene.box.wrap(window.positions).equal(window.positions)
    assert displacements.norm(dim=-1).max() <= 0.3 * scene.particle_spacing * (1 + 1e-9)
    assert displacements.mean(dim=1).abs().max() < 0.01 * displacements.abs().max()


def test_quartiles_of_few_times_stay_among_them(benchmark_script):
    """Quartiles that extrapolate gave a ratio of two times below zero."""
    found = benchmark_script("inference").quartiles([0.2, 3.0])
    assert 0.2 <= found["low"] <= found["median"] <= found["high"] <= 3.0


def test_edges_have_the_neighbours_that_were_asked_for(benchmark_script, generator):
    positions = torch.rand(500, 3, generator=generator)
    edges = benchmark_script("continuous_conv").edges_with(positions, 20)
    assert len(edges) / 500 == pytest.approx(20, rel=0.05)


def test_the_decay_of_vortices_is_checked_with_the_solver_that_makes_data_and_with_a_transport_velocity(
    solver_benchmark,
):
    scene = scene_named("taylor_green_2d", particle_spacing=0.04)
    solvers = {name: solver_of(scene) for name, solver_of in solver_benchmark.TAYLOR_GREEN_SOLVERS.items()}
    pressures = {name: solver._scheme.transport_pressure for name, solver in solvers.items()}
    assert pressures["as data are made"] == scene.solver()._scheme.transport_pressure == 0
    assert pressures["transport velocity"] > 0


@pytest.mark.slow
@pytest.mark.timeout(3 * PATIENCE)
def test_the_benchmark_of_gns_times_network_and_geometry(tmp_path):
    run("gns", "--turns", "3", "--out", tmp_path / "gns.json")
    found = json.loads((tmp_path / "gns.json").read_text())
    assert found["particles"] == 64
    for part in ("network_ms", "geometry_ms"):
        assert 0 < found[part]["low"] <= found[part]["median"] <= found[part]["high"]
