"""What the trainings of a study share."""

import pickle
from dataclasses import replace
from types import SimpleNamespace

import pytest
import torch
from systems import configured, periodic_frame, periodic_scene, problem, window_of

from cconv.data.trajectory import Trajectory
from cconv.data.window import Windows
from cconv.errors import ConfigError
from cconv.forces import ReversePoiseuilleForce
from cconv.models.relaxation import Relaxation
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
    unfitted = SimpleNamespace(task=task, predict_frame=None, config=config, home=torch.device("cpu"))
    training = TrainingConfig(pushforward=5, pushforward_from=0.0)
    given = replace(problem(generator), train_samples=samples)
    drawn = [given.examples(training, seed, task).draw([0], 0, unfitted) for seed in range(20)]
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
            for sample in each.examples(training, 1, model.task).draw([2], 5, model)
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


OPPOSITE = ReversePoiseuilleForce(400.0, 1.0)


def falling(generator, force=OPPOSITE):
    """A problem of steps whose scene has a strong force, by which its particles were not moved."""
    scene = replace(periodic_scene(), force=force)
    windows = [window_of(periodic_frame(generator), generator) for _ in range(3)]
    samples = WindowSamples(windows, scene, task_named("acceleration"))
    return Problem(scene=scene, task=samples.task, train_samples=samples, valid_samples=samples)


def test_targets_are_standardised_after_the_force_was_taken_off(generator):
    """What was not moved by the force has to be moved against it, so that targets spread more than before."""
    given = falling(generator)
    every = of_history(6)
    plain, without = (given.build_model(every._replace(external_force=who), 0) for who in ("network", "integrator"))
    spacing = given.scene.particle_spacing
    force = OPPOSITE.smoothed(without.task.force_travel * spacing)
    for sample, other in zip(given._typical(plain.task), given._typical(without.task), strict=True):
        added = force(sample.window.present) * given.scene.frame_dt**2 / spacing
        torch.testing.assert_close(sample.target - other.target, added, rtol=0, atol=1e-5)
    assert without.target_scale.max() > 2 * plain.target_scale.max()
    assert (plain.config.force_travel, without.config.force_travel is None) == (None, False)
    (drawn,) = given.examples(TrainingConfig(noise=0.01), 1, without.task).draw([0], 1, without)
    assert drawn.task == without.task


def test_the_travel_is_the_deviation_of_the_displacements_in_particle_spacings(generator):
    given = falling(generator)
    moved = torch.cat([each.last_displacements(given.scene.box) for each in given.train_samples.windows])
    deviation = float((moved - moved.mean(dim=0)).square().mean().sqrt())
    task = given.task_of(of_history(6)._replace(external_force="integrator"))
    assert task.force_travel == pytest.approx(deviation / given.scene.particle_spacing)


def test_a_rollout_of_the_model_adds_the_force_that_its_samples_do_not(generator):
    """Errors of a model are those of its own integrator, also where the samples are of the study's task."""
    given = falling(generator)
    model = given.build_model(of_history(6)._replace(external_force="integrator"), 0)
    (first, *_) = given.valid_samples
    other = given.valid_samples.of_task(model.task)[0]
    assert given.objective.error(model, [first]) == given.objective.error(model, [other])


def test_no_integrator_adds_a_force_that_is_not_there(generator):
    with pytest.raises(ConfigError, match="there is no external force"):
        falling(generator, None).build_model(of_history(6)._replace(external_force="integrator"), 0)


def test_models_have_the_relaxation_of_their_configuration(generator):
    given, relaxation = falling(generator), Relaxation(alpha=0.02)
    plain, relaxed = (given.build_model(of_history(6)._replace(relaxation=each), 0) for each in (None, relaxation))
    assert (plain.config.relaxation, relaxed.config.relaxation) == (None, relaxation)
    assert given.valid_error(relaxed) != given.valid_error(plain)


def test_a_problem_of_steps_is_as_large_as_its_frames_when_it_is_sent(generator):
    """Typical samples are parts of trajectories; each of them must not take its whole trajectory along."""

    def sent(frames):
        start = window_of(periodic_frame(generator), generator, future=1)
        path = torch.cat([start.positions, start.future])
        stored = Trajectory(
            first_frame=0,
            positions=path[torch.arange(frames) % len(path)],
            velocities=torch.zeros(frames, *path.shape[1:]),
            masses=start.masses,
            particle_types=start.particle_types,
            boundary=None,
            name="long",
        )
        samples = WindowSamples(Windows([stored], 6, 1, further=20), periodic_scene(), task_named("acceleration"))
        given = Problem(scene=samples.scene, task=samples.task, train_samples=samples, valid_samples=samples)
        given.build_model(of_history(6), 0)
        return len(pickle.dumps(given)), stored.positions.nbytes

    (small, of_small), (large, of_large) = sent(206), sent(1006)  # 100 typical samples of each
    assert large - small < 3 * (of_large - of_small)  # positions and velocities
