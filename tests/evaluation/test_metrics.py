import dataclasses
from dataclasses import replace

import numpy as np
import pytest
import torch
from systems import configured, problem

from cconv.evaluation.metrics import blocks_of_errors, own_variance, per_frame_normalized_mse
from cconv.models.errors import FrameError, frame_errors, mean_predictor_error, normalized_mse


def error(value, trajectory="0", frame=0, particles=10):
    return FrameError(
        trajectory=trajectory,
        frame=frame,
        num_particles=particles,
        normalized_mse=value,
        per_frame_normalized_mse=value,
    )


def test_predicting_the_training_mean_has_error_one_on_the_training_split(generator):
    given = problem(generator)
    model = given.build_model(configured(layers=1, kernel_size=3), 0)
    for parameter in model.parameters():
        torch.nn.init.zeros_(parameter)
    assert normalized_mse(frame_errors(model, given.train_samples)) == pytest.approx(1, rel=1e-5)


@pytest.mark.parametrize("task", ["density_rate", "density_gradient"])
def test_the_mean_predictor_scores_one_on_the_training_split_and_its_own_on_others(task, generator):
    given = problem(generator, task)
    own = mean_predictor_error(given.train_samples, given.train_samples)
    assert normalized_mse(own) == pytest.approx(1)
    targets = torch.cat([sample.target for sample in given.train_samples]).double()
    calm = [dataclasses.replace(sample, target=0.1 * sample.target) for sample in given.valid_samples]
    expected = torch.cat([sample.target for sample in calm]).double() - targets.mean(dim=0)
    expected = expected.square().mean() / targets.var(dim=0, correction=0).mean()
    errors = mean_predictor_error(calm, given.train_samples)
    assert normalized_mse(errors) == pytest.approx(expected.item())
    assert normalized_mse(errors) < 0.1
    assert len(blocks_of_errors(errors, 1)) == len(calm)


def test_per_frame_error_divides_by_the_frames_own_variance(generator):
    given = problem(generator)
    model = given.build_model(configured(layers=1, kernel_size=3), 0)
    entry = frame_errors(model, given.valid_samples[:1])[0]
    target = given.valid_samples[0].target * given.valid_samples[0].target_unit
    physical = (model.predict(given.valid_samples[0].inputs) - target).square().mean() / target.var(correction=0)
    assert entry.per_frame_normalized_mse == pytest.approx(physical.item(), rel=1e-4)
    assert per_frame_normalized_mse([entry]) == entry.per_frame_normalized_mse


def test_frames_count_by_their_particles():
    assert normalized_mse([error(1.0, particles=30), error(5.0, particles=10)]) == pytest.approx(2)


def test_units_are_trajectories_where_there_are_several():
    errors = [error(1.0, "a"), error(3.0, "a", 1), error(7.0, "b")]
    np.testing.assert_allclose(blocks_of_errors(errors, 1), [2, 7])


def test_units_are_time_blocks_of_a_single_trajectory():
    errors = [error(float(frame), frame=frame) for frame in range(11)]
    np.testing.assert_allclose(blocks_of_errors(errors, 3), [1, 4, 7, 9.5])
    np.testing.assert_allclose(blocks_of_errors(errors[:2], 5), [0.5])


def test_frames_with_a_constant_target_do_not_count_in_the_per_frame_error():
    undefined = FrameError(trajectory="0", frame=0, num_particles=10, normalized_mse=1.0, per_frame_normalized_mse=None)
    assert per_frame_normalized_mse([undefined, error(0.5)]) == 0.5
    assert per_frame_normalized_mse([undefined]) is None


def test_an_error_by_the_own_variance_is_1_for_the_own_mean(generator):
    given = problem(generator)
    model = given.build_model(configured(layers=1, kernel_size=3), 0)
    calm = [replace(sample, target=0.1 * sample.target + 3.0) for sample in given.valid_samples]
    targets = torch.cat([sample.target for sample in calm]).double()
    own_mean = (targets.mean() - targets).square().mean() / float(model.target_scale) ** 2
    assert own_variance(model, calm) == pytest.approx(float(own_mean), rel=1e-4)
