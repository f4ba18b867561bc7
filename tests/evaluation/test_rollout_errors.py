"""Errors of rollouts: 0 for the truth, the worst for what diverges, and MSE_n between."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from systems import configured, model_of, periodic_frame, periodic_scene, samples, window_of

from cconv.errors import ConfigError
from cconv.evaluation.objectives import RolloutMSE
from cconv.evaluation.rollout_errors import (
    constant_rollouts,
    joined_errors,
    rollout_errors,
    rollouts_of,
    starts,
    worst_error,
)
from cconv.tasks import task_named
from cconv.tasks.samples import WindowSamples

TASK, SCENE = task_named("acceleration"), periodic_scene()


def begun(generator, count=1):
    windows = [window_of(periodic_frame(generator), generator, future=4) for _ in range(count)]
    return list(WindowSamples(windows, SCENE, TASK))


def test_replayed_targets_have_no_error(generator):
    (start,) = begun(generator)
    found = rollout_errors(TASK.target, start)
    assert found.diverged is None
    assert found.error < 1e-12
    assert (found.trajectory, found.frame, len(found.errors)) == ("0", 5, 4)


def test_the_error_is_the_squared_distance_to_the_stored_frame(generator):
    """A target leads to the stored frame from wherever the rollout is, so that what is added to it remains."""
    (start,) = begun(generator)
    push = 1e-3
    found = rollout_errors(lambda window, scene: TASK.target(window, scene) + push, start)
    assert found.errors == pytest.approx(np.full(4, push**2), rel=1e-3)


def test_frames_after_a_divergence_count_as_the_worst(generator):
    (start,) = begun(generator)

    def predict(window, scene):
        return TASK.target(window, scene) * (torch.nan if window.frame == 7 else 1.0)

    found = rollout_errors(predict, start)
    assert found.diverged == "positions are not finite"
    assert worst_error(SCENE.box) == 0.25
    assert found.errors == pytest.approx([0, 0, 0.25, 0.25], abs=1e-9)


def test_no_frame_counts_as_more_than_the_worst(generator):
    (start,) = begun(generator)
    generator_of_answers = torch.Generator().manual_seed(0)

    def predict(window, scene):
        return 0.5 * torch.rand(64, 2, generator=generator_of_answers, dtype=torch.float64)

    assert rollout_errors(predict, start).errors.max() <= worst_error(SCENE.box)


def test_only_steps_can_be_rolled_out(generator):
    with pytest.raises(ConfigError, match="needs windows of a step task"):
        starts(samples(generator, 2))


def test_units_are_trajectories_or_single_rollouts(generator):
    class Replay:
        task, home = TASK, torch.device("cpu")
        predict_frame = staticmethod(TASK.target)

    alone = begun(generator, 3)
    assert RolloutMSE().table(Replay(), alone, 1).units.shape == (3,)
    table = RolloutMSE().table(Replay(), [*alone, *(replace(start, trajectory="1") for start in alone)], 1)
    assert table.units.shape == (2,)
    assert table.error < 1e-12
    assert table.measures["diverged rollouts"] == 0


def test_mse5_is_the_mean_of_the_first_five_frames_where_there_are_five(generator):
    class Pushed:
        task, home = TASK, torch.device("cpu")

        @staticmethod
        def predict_frame(window, scene):
            return TASK.target(window, scene) + 1e-3 * (window.frame >= 10)

    windows = [window_of(periodic_frame(generator), generator, future=future) for future in (7, 4)]
    long, short = ([each] for each in WindowSamples(windows, SCENE, TASK))
    table = RolloutMSE().table(Pushed(), long, 1)
    assert table.error == pytest.approx(2 / 7 * 1e-6, rel=1e-3)  # windows begin at frame 5
    assert table.measures["MSE5"] == pytest.approx(0.0, abs=1e-12)
    assert RolloutMSE().table(Pushed(), short, 1).measures["MSE5"] is None


def test_the_mean_predictor_goes_on_with_the_mean_acceleration(generator):
    train, valid = begun(generator, 2), begun(generator, 2)
    mean = torch.cat([each.target * each.target_unit for each in train]).double().mean(dim=0)
    expected = np.mean([each.error for each in constant_rollouts(mean, valid)])
    assert RolloutMSE().of_mean_predictor(valid, train) == pytest.approx(expected)
    assert expected > 1e-8


def assert_alike(found, expected, tolerance):
    assert [each.diverged for each in found] == [each.diverged for each in expected]
    assert [(each.trajectory, each.frame) for each in found] == [(each.trajectory, each.frame) for each in expected]
    for ours, theirs in zip(found, expected, strict=True):
        assert ours.errors == pytest.approx(theirs.errors, rel=tolerance)


@pytest.mark.parametrize("architecture", ["conv_net", "radial_net"])
def test_rollouts_that_advance_together_have_the_errors_that_they_have_alone(architecture, generator):
    """Their order stays, also where some know fewer frames, and are in another graph."""
    windows = [window_of(periodic_frame(generator), generator, future=future) for future in (3, 2, 3, 3)]
    windows = [replace(window, trajectory=str(number), frame=number) for number, window in enumerate(windows)]
    begun_at = list(WindowSamples(windows, SCENE, TASK))
    sizes = {"layers": 2, "first_channels": 4, "kernel_size": 3, "radial_terms": 4, "conserves_momentum": True}
    model = model_of(configured(architecture=architecture, **sizes), SCENE, TASK.name, begun_at, generator)
    graphs = []

    def counted(window, scene):
        graphs.append(len(window.origins))
        return model.predict_frame(window, scene)

    alone = [rollout_errors(model.predict_frame, start) for start in begun_at]
    assert_alike(joined_errors(counted, begun_at), alone, 1e-4)
    assert graphs == [3, 3, 3, 1, 1]
    assert_alike(rollouts_of(model, begun_at), alone, 1e-4)


def test_what_diverges_leaves_the_others_and_is_the_worst_from_there(generator):
    """One breaks, one clumps, one goes on; nobody is asked again about those that have left."""
    begun_at = list(WindowSamples(begun_windows(generator), FINE, TASK))
    asked = []

    def predict(window, scene):
        asked.append([origin.trajectory for origin in window.origins])
        return torch.cat([answer_about(part, scene) for part in window.separated()])

    def answer_about(window, scene):
        step = window.frame - 5
        if window.trajectory == "breaks" and step == 1:
            return torch.full_like(window.present, torch.nan)
        if window.trajectory == "clumps" and step == 2:
            away = scene.box.displacement(torch.full((1, 2), 0.53, dtype=torch.float64), window.present)
            near = away.norm(dim=1, keepdim=True) < 0.35
            return torch.where(near, away, 0.0) - window.last_displacements(scene.box)
        return TASK.target(window, scene)

    found = joined_errors(predict, begun_at)
    alone = [rollout_errors(predict, start) for start in begun_at]
    assert_alike(found, alone, 1e-9)
    assert asked[:4] == [["breaks", "goes", "clumps"], ["breaks", "goes", "clumps"], ["goes", "clumps"], ["goes"]]
    assert found[0].diverged == "positions are not finite"
    assert found[1].diverged is None
    assert "clumped" in found[2].diverged
    assert found[0].errors == pytest.approx([0, 0.25, 0.25, 0.25], abs=1e-9)
    assert found[2].errors == pytest.approx([0, 0, 0.25, 0.25], abs=1e-9)


FINE = periodic_scene(16)


def begun_windows(generator):
    windows = [window_of(periodic_frame(generator, 16), generator, future=4) for _ in range(3)]
    names = ("breaks", "goes", "clumps")
    return [replace(window, trajectory=name) for window, name in zip(windows, names, strict=True)]
