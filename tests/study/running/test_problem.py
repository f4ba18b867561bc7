"""What the trainings of a study share."""

from dataclasses import replace
from types import SimpleNamespace

import pytest
import torch
from systems import configured, periodic_frame, periodic_scene, problem, window_of

from cconv.study.declared.configuration import DEFAULTS, TrainingConfig
from cconv.study.running.problem import Problem
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
    samples, config = WindowSamples([window], periodic_scene(), task), SimpleNamespace(features=task.features)
    unfitted = SimpleNamespace(task=task, predict_frame=None, config=config)
    training = TrainingConfig(pushforward=5, pushforward_from=0.0)
    given = replace(problem(generator), train_samples=samples)
    drawn = [given.examples(training, seed, task.history).draw([0], 0, unfitted) for seed in range(20)]
    assert {sample.frame for (sample,) in drawn} == {window.frame}


def steps(generator, history):
    """A problem of steps whose windows have so many frames, and a shorter history of the same presents as any other."""
    windows = [window_of(periodic_frame(generator), generator, 6) for _ in range(3)]
    samples = WindowSamples(
        [window.ending(history) for window in windows], periodic_scene(), task_named("acceleration", history=history)
    )
    return Problem(scene=periodic_scene(), task=samples.task, train_samples=samples, valid_samples=samples)


def of_history(history):
    every = DEFAULTS._replace(features=task_named("acceleration").features, history=history)
    return configured(every, architecture="radial_net", layers=1, radial_terms=4, message="mixed")


@pytest.mark.parametrize("history", [2, 3, 6])
def test_a_model_does_not_depend_on_the_longest_history_that_others_have(history, generator):
    """Neither its inputs and standardisation nor its noisy examples: only the presents are shared."""
    seed = generator.initial_seed()
    long, short = (steps(torch.Generator().manual_seed(seed), frames) for frames in (6, history))
    configuration = of_history(history)
    models = [each.build_model(configuration, 0) for each in (long, short)]
    assert models[0].config == models[1].config
    assert models[0].config.history == history
    known = models[1].state_dict()
    assert all(torch.equal(value, known[name]) for name, value in models[0].state_dict().items())
    for training in (TrainingConfig(), TrainingConfig(noise=0.02)):
        drawn = [
            sample
            for each, model in zip((long, short), models, strict=True)
            for sample in each.examples(training, 1, history).draw([2], 5, model)
        ]
        assert drawn[0].frame == drawn[1].frame
        assert torch.equal(drawn[0].inputs.features.flat(), drawn[1].inputs.features.flat())
        assert torch.equal(drawn[0].target, drawn[1].target)


@pytest.mark.parametrize(("history", "accelerations"), [(2, 0), (3, 1), (6, 4)])
def test_a_network_is_given_the_accelerations_of_its_history(history, accelerations, generator):
    problem = steps(generator, 6)
    model = problem.build_model(of_history(history), 0)
    assert ("accelerations" in model.config.features) == (accelerations > 0)
    assert model.config.inputs.vectors == accelerations + 1  # and the velocity
    window = problem.valid_samples.windows[0]
    assert model.predict_frame(window, problem.scene).shape == (64, 2)
    assert torch.equal(
        model.predict_frame(window, problem.scene), model.predict_frame(window.ending(history), problem.scene)
    )
