"""Rollouts of finalists over whole test trajectories are recorded, with the frames of one for the animation."""

from types import SimpleNamespace

import numpy as np
import pytest
from systems import untrained_step

from cconv.data.dataset import open_dataset
from cconv.models.checkpoint import load_model, save_model
from cconv.models.model import Model
from cconv.report.rollout_animation import animated
from cconv.study.records.rollouts import read_rollouts
from cconv.study.records.run_folder import RunFolder
from cconv.study.stages.finalists import Retrained
from cconv.study.stages.rolled import record_rollouts

SEEDS = ("seed_1", "seed_2")


@pytest.fixture
def session(steps_folder, tmp_path):
    """What the stage needs of a session, in an empty run folder."""
    dataset = open_dataset(steps_folder)
    return SimpleNamespace(
        run=RunFolder(tmp_path / "run"),
        dataset=dataset,
        problem=SimpleNamespace(task=untrained_step(steps_folder).task),
        progress=lambda items, _: items,
        load_model=load_model,
    )


@pytest.fixture
def finalist(steps_folder, tmp_path):
    """Two trainings of a model that predicts no acceleration."""
    model = untrained_step(steps_folder)
    checkpoints = [tmp_path / seed for seed in SEEDS]
    for checkpoint in checkpoints:
        save_model(model, checkpoint, {})
    records = [SimpleNamespace(id=seed, best=1.0) for seed in SEEDS]
    return Retrained(id="a", records=records, checkpoints=checkpoints)


def rolled(session, finalist):
    assert record_rollouts(session, [finalist], "a") == ("a",)
    return read_rollouts(session.run, ["a"])["a"]


def test_every_training_is_rolled_out_and_the_first_one_kept(session, finalist):
    found = rolled(session, finalist)
    stored = session.dataset.trajectory("test", 0).positions
    assert [(each.seed, each.trajectory) for each in found.rolled] == [(seed, "test/00000") for seed in SEEDS]
    first = found.rolled[0]
    history = session.problem.task.history
    assert first.stored == len(stored) - history
    kept = open_dataset(session.run.path / "rollouts" / "recommended").trajectory("test", 0).positions
    assert len(kept) == history + len(first.mse)
    apart = session.dataset.scene.box.displacement(kept[history:].double(), stored[history : len(kept)].double())
    assert np.allclose(first.mse, apart.square().mean(dim=(1, 2)), rtol=1e-3, atol=1e-12)
    assert len(first.sinkhorn) == 4
    assert all(value >= 0 for value in first.sinkhorn)
    assert found.rolled[1].sinkhorn == ()  # one takes seconds
    energies = zip(first.rollout.e_kin, first.reference.e_kin, strict=True)
    assert first.e_kin_error == pytest.approx(np.mean([(ours - stored) ** 2 for ours, stored in energies]))
    assert animated(session.run.path / "rollouts" / "recommended").startswith("R0lGOD")
    assert rolled(session, finalist).rolled[0].mse == first.mse  # once more, as after an interruption


def test_a_rollout_without_a_frame_is_lost_and_named(session, finalist, monkeypatch):
    predict = Model.predict_frame
    monkeypatch.setattr(Model, "predict_frame", lambda *given: predict(*given) * float("nan"))
    found = rolled(session, finalist)
    assert found.rolled == ()
    assert "seed_2, trajectory test/00000: the rollout diverged" in found.lost[1]
    assert not (session.run.path / "rollouts" / "recommended").exists()


def test_ctrl_c_ends_the_study(session, finalist, monkeypatch):
    predict, answers = Model.predict_frame, SimpleNamespace(count=0)

    def stops(*given):
        answers.count += 1
        if answers.count > 2:
            raise KeyboardInterrupt
        return predict(*given)

    monkeypatch.setattr(Model, "predict_frame", stops)
    with pytest.raises(KeyboardInterrupt):
        record_rollouts(session, [finalist], "a")


def test_a_field_has_no_rollouts(finalist):
    session = SimpleNamespace(problem=SimpleNamespace(task=object()))
    assert record_rollouts(session, [finalist], "a") == ()
