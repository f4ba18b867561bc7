"""Errors of rollouts: 0 for the truth, the worst for what diverges, and MSE_n between."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from systems import periodic_frame, periodic_scene, samples, window_of

from cconv.errors import ConfigError
from cconv.evaluation.objectives import RolloutMSE
from cconv.evaluation.rollout_errors import constant_rollouts, rollout_errors, starts, worst_error
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
        task = TASK
        predict_frame = staticmethod(TASK.target)

    alone = begun(generator, 3)
    assert RolloutMSE().table(Replay(), alone, 1).units.shape == (3,)
    table = RolloutMSE().table(Replay(), [*alone, *(replace(start, trajectory="1") for start in alone)], 1)
    assert table.units.shape == (2,)
    assert table.error < 1e-12
    assert table.measures["diverged rollouts"] == 0


def test_the_mean_predictor_goes_on_with_the_mean_acceleration(generator):
    train, valid = begun(generator, 2), begun(generator, 2)
    mean = torch.cat([each.target * each.target_unit for each in train]).double().mean(dim=0)
    expected = np.mean([each.error for each in constant_rollouts(mean, valid)])
    assert RolloutMSE().of_mean_predictor(valid, train) == pytest.approx(expected)
    assert expected > 1e-8
