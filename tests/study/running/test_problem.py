"""What the trainings of a study share."""

from dataclasses import replace
from types import SimpleNamespace

import pytest
import torch
from systems import configured, periodic_frame, periodic_scene, problem, window_of

from cconv.study.declared.configuration import TrainingConfig
from cconv.tasks import task_named
from cconv.tasks.samples import WindowSamples

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


def test_a_closed_form_is_fitted_to_stored_windows_however_early_pushforward_begins(generator):
    """Before it is fitted, its own rollout leads nowhere."""
    window = window_of(periodic_frame(generator), generator, future=6)
    task = task_named("acceleration")
    samples, unfitted = WindowSamples([window], periodic_scene(), task), SimpleNamespace(task=task, predict_frame=None)
    training = TrainingConfig(pushforward=5, pushforward_from=0.0)
    drawn = [
        replace(problem(generator), train_samples=samples).examples(training, seed).draw(0, 0, unfitted)
        for seed in range(20)
    ]
    assert {sample.frame for sample in drawn} == {window.frame}
