"""The benchmark script runs and writes what it says, on layers too small for its figures to mean anything."""

import os

import pytest
import torch


@pytest.fixture
def benchmark(benchmark_script):
    module = benchmark_script("continuous_conv")
    threads = torch.get_num_threads()
    yield module
    torch.set_num_threads(threads)


def test_measures_draws_and_compares(benchmark, monkeypatch, tmp_path):
    cores = len(os.sched_getaffinity(0))

    case = benchmark.Case

    def tiny(**changes):
        settings = {"num_particles": 60, "neighbors": 5, "kernel_size": 2, "in_channels": 4, "out_channels": 3}
        return case(**changes | settings | {"threads": cores, "out_channels": changes.get("out_channels", 3)})

    sweeps = {name: [tiny(), tiny(out_channels=1)] for name in benchmark.SWEEPS}
    monkeypatch.setattr(benchmark, "SWEEPS", sweeps)
    monkeypatch.setattr(benchmark, "HAS_OPEN3D", False)
    monkeypatch.setattr(benchmark, "Case", tiny)
    monkeypatch.setattr(benchmark, "in_fresh_process", lambda function, *arguments: function(*arguments))
    monkeypatch.setattr(benchmark, "extra_megabytes", lambda case, variant: 1.0)
    table = benchmark.measure_sweeps(0.0)
    layers = table[table.sweep != "memory"]
    assert set(layers.variant) == {"ours", "general path", "matrix products"}
    assert not layers[["low", "ms", "high"]].isna().any().any()
    assert table.loc[table.variant == "ours", "difference"].max() < 1e-5
    benchmark.draw(table, tmp_path / "figure.png")
    assert (tmp_path / "figure.png").stat().st_size > 10_000
    ratios = benchmark.ratios(benchmark.measure_targets(None, 0.0)).set_index("what").measured
    assert {"the same: ours / matrix products", "geometry of 100,000 edges / layer"} <= set(ratios.index)
    assert ratios["extra memory at N = 100,000, MB"] == 1


def test_edges_have_the_neighbours_that_were_asked_for(benchmark, generator):
    positions = torch.rand(500, 3, generator=generator)
    edges = benchmark.edges_with(positions, 20)
    assert len(edges) / 500 == pytest.approx(20, rel=0.05)
