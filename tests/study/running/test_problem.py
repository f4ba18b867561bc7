"""What the trainings of a study share."""

from dataclasses import replace

import pytest
import torch
from systems import configured, problem

NETWORK = configured(layers=1, kernel_size=3)


@pytest.mark.parametrize("task", ["density_rate", "density_gradient"])
def test_a_model_is_standardised_by_the_training_split_alone(generator, task):
    given, other = problem(generator, task), problem(generator, task)
    model = given.build_model(NETWORK, 0)
    on_other_validation = replace(given, valid_samples=other.valid_samples).build_model(NETWORK, 0)
    on_other_training = replace(given, train_samples=other.train_samples).build_model(NETWORK, 0)
    known = model.state_dict()
    assert all(torch.equal(value, known[name]) for name, value in on_other_validation.state_dict().items())
    assert not torch.equal(on_other_training.feature_mean, model.feature_mean)
    assert not torch.equal(on_other_training.target_scale, model.target_scale)
