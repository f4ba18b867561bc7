"""The select stage asks every seed of a finalist whether it is stable."""

from types import SimpleNamespace

import torch
from systems import configured, periodic_scene, periodic_trajectory, problem

from cconv.models.checkpoint import load_model, save_model
from cconv.study.stages.finalists import Retrained
from cconv.study.stages.select import _stress


def test_every_seed_of_a_finalist_is_stressed(generator, tmp_path, monkeypatch):
    """One of two seeds predicts no numbers, and not the best one; the failures name it."""
    given = problem(generator)
    for seed in (1, 2):
        model = given.build_model(configured(layers=1, kernel_size=3), seed)
        if seed == 2:
            torch.nn.init.constant_(next(model.parameters()), 3e38)  # no file may hold nan
        save_model(model, tmp_path / str(seed), {})
    records = [SimpleNamespace(id=f"baseline/seed_{seed}", best=0.1 * seed) for seed in (1, 2)]
    finalist = Retrained(id="baseline", records=records, checkpoints=[tmp_path / "1", tmp_path / "2"])
    session = SimpleNamespace(
        problem=given,
        dataset=SimpleNamespace(scene=periodic_scene()),
        progress=lambda items, label: items,
        load_model=load_model,
    )
    stored = [periodic_trajectory(generator)]
    monkeypatch.setattr("cconv.study.stages.checked.kept_trajectories", lambda dataset, split: stored)
    checks, found = _stress(session, [finalist])
    assert list(checks) == list(given.task.checks)
    assert found["baseline"].counts.seeds == 2
    precise = [line for line in found["baseline"].failures if "float32" in line]
    assert len(precise) == 1
    assert "seeds baseline/seed_2 of 2" in precise[0]
