"""The benchmark script of predictions runs and draws, on a scene too small for its figures to mean anything."""

from functools import partial
from pathlib import Path

import pytest
from systems import periodic_frame, periodic_scene, with_walls

from cconv.evaluation import cost


@pytest.fixture
def benchmark(benchmark_script, monkeypatch, generator):
    module = benchmark_script("inference")
    scene = periodic_scene()
    frame = with_walls(periodic_frame(generator))
    monkeypatch.setattr(module, "frame_of", lambda folder: (scene, frame))
    monkeypatch.setattr(module, "SPACING", scene.particle_spacing)
    monkeypatch.setattr(module, "DIM", scene.dim)
    monkeypatch.setattr(module, "SEARCHES", [(dim, 100, periodic) for dim in (1, 2, 3) for periodic in (False, True)])
    monkeypatch.setattr(module, "CHECKED", dict(list(module.CHECKED.items())[:6]))
    monkeypatch.setattr(cost, "peak_megabytes", lambda load, models, *others: dict.fromkeys(models, 1.0))
    monkeypatch.setattr(cost, "measure_growth", partial(cost.measure_growth, sizes=(50, 100)))
    return module


class SameProcess:
    """Stands for a process that times another state of the code."""

    def __init__(self, module, searches):
        self.calls = module.Calls(Path(), searches).calls

    def time(self, name):
        return self.calls[name]()

    def close(self):
        pass


def test_quartiles_of_few_times_stay_among_them(benchmark):
    """Quartiles that extrapolate gave a ratio of two times below zero."""
    found = benchmark.quartiles([0.2, 3.0])
    assert 0.2 <= found["low"] <= found["median"] <= found["high"] <= 3.0


def test_compares_two_states_measures_growth_and_draws(benchmark, monkeypatch, tmp_path):
    monkeypatch.setattr(benchmark, "State", lambda checkout, data, searches: SameProcess(benchmark, searches))
    compared = benchmark.compare({"before": Path(), "now": Path()}, Path(), benchmark.SEARCHES, rounds=2)
    assert len(compared) == len(benchmark.COMPARED) + len(benchmark.SEARCHES)
    for row in compared.values():
        assert {"before", "now", "before / now"} <= row.keys()
        assert row["before / now"].keys() == {"median", "low", "high"}
    assert compared["published network"]["published now / this now"]["median"] == 1
    results = {"machine": "any", "num_particles": 64, "compared": compared, **benchmark.measure_checks(Path(), 4)}
    assert results["growth"].keys() == {*benchmark.COMPARED, cost.ANALYTIC}
    assert results["costs"].keys() == benchmark.CHECKED.keys()
    assert len(results["analytic"]["turns_ms"]) == 2
    benchmark.draw(results, tmp_path / "inference.png")
    assert (tmp_path / "inference.png").stat().st_size > 10_000
