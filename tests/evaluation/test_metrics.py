import numpy as np
import pytest
import torch
from systems import problem

from cconv.evaluation.metrics import (
    FrameError,
    blocks_of_errors,
    crossed_interval,
    frame_errors,
    normalized_mse,
    per_frame_normalized_mse,
)
from cconv.training.field_model import NetworkConfig


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
    model = given.build_model(NetworkConfig(layers=1, kernel_size=3), 0)
    for parameter in model.parameters():
        torch.nn.init.zeros_(parameter)
    assert normalized_mse(frame_errors(model, given.train_samples)) == pytest.approx(1, rel=1e-5)


def test_per_frame_error_divides_by_the_frames_own_variance(generator):
    given = problem(generator)
    model = given.build_model(NetworkConfig(layers=1, kernel_size=3), 0)
    entry = frame_errors(model, given.valid_samples[:1])[0]
    target = given.valid_samples[0].target
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


def test_interval_is_positive_holds_the_mean_and_shrinks_to_a_constant():
    table = np.random.default_rng(0).lognormal(size=(3, 4))
    low, high = crossed_interval(table, table.mean())
    assert 0 < low < table.mean() < high
    assert crossed_interval(np.full((2, 3), 0.5), 0.5) == (0.5, 0.5)


def test_interval_of_a_single_unit_covers_the_seeds():
    low, high = crossed_interval(np.array([[1.0], [1.1], [1.2]]), 1.1)
    assert low < 1.0
    assert high > 1.2


@pytest.mark.parametrize(("seeds", "units"), [(2, 1), (2, 3), (3, 3), (3, 4), (5, 12)])
def test_interval_covers_the_true_mean_as_often_as_it_says(seeds, units):
    """Crossed normal effects of 10 % around a known mean, at the sizes that studies use."""
    rng = np.random.default_rng(1)
    covered = 0
    for _ in range(600):
        effects = (
            rng.normal(size=(seeds, 1)),
            rng.normal(size=(1, units)) * (units > 1),
            rng.normal(size=(seeds, units)),
        )
        table = 1 + 0.1 * sum(effects) / 3
        low, high = crossed_interval(table, table.mean())
        covered += low <= 1 <= high
    assert 0.92 <= covered / 600 <= 1
