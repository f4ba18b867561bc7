"""The random walk of Sanchez-Gonzalez et al. (2020): its size, where it begins, and what it asks of a model."""

from dataclasses import replace
from types import SimpleNamespace

import torch
from systems import periodic_frame, periodic_scene, window_of

from cconv.data.trajectory import ParticleType
from cconv.tasks import task_named
from cconv.tasks.samples import WindowSamples
from cconv.training.augmentation import RandomWalkNoise
from cconv.training.examples import AugmentedExamples, StoredExamples
from cconv.training.unroll import Pushforward

TASK, SCENE = task_named("acceleration"), periodic_scene(40)
NOISE, NEVER = RandomWalkNoise(0.05), Pushforward(0, 0)
CONFIG, CPU = SimpleNamespace(features=TASK.features), torch.device("cpu")
MODEL = SimpleNamespace(task=TASK, predict_frame=TASK.target, config=CONFIG, home=CPU)


def noisy_and_clean(generator):
    window = window_of(periodic_frame(generator, 40), generator)
    return NOISE(window, SCENE, generator), window


def test_the_noise_of_the_last_velocity_has_the_deviation_asked_for(generator):
    noisy, clean = noisy_and_clean(generator)
    noise = SCENE.box.displacement(noisy.positions, clean.positions.double()) / SCENE.particle_spacing
    velocities = noise.diff(dim=0)
    assert torch.equal(noisy.positions[0], SCENE.box.wrap(clean.positions[0].double()))
    for steps, velocity in enumerate(velocities, start=1):
        expected = 0.05 * (steps / 5) ** 0.5
        assert abs(float(velocity.std()) / expected - 1) < 0.05
    assert abs(float(velocities[-1].mean())) < 0.005


def test_the_target_takes_the_last_velocitys_noise_back(generator):
    noisy, clean = noisy_and_clean(generator)
    noise = SCENE.box.displacement(noisy.positions, clean.positions.double()).diff(dim=0)[-1]
    difference = TASK.target(noisy, SCENE) - TASK.target(clean, SCENE)
    torch.testing.assert_close(difference, -noise, rtol=1e-4, atol=1e-6)


def test_what_is_no_fluid_is_left_alone(generator):
    window = window_of(periodic_frame(generator, 40), generator)
    types = window.particle_types.clone()
    types[:100] = ParticleType.MOVING_WALL
    window = replace(window, particle_types=types)
    noisy = NOISE(window, SCENE, generator)
    assert torch.equal(noisy.positions[:, :100], SCENE.box.wrap(window.positions[:, :100].double()))
    assert torch.equal(noisy.future[:, :100], SCENE.box.wrap(window.future[:, :100].double()))


def test_noise_differs_between_updates_and_not_between_runs(generator):
    scene = periodic_scene()
    windows = [window_of(periodic_frame(generator), generator) for _ in range(2)]
    samples = WindowSamples(windows, scene, TASK)
    examples, again = (AugmentedExamples(samples, NOISE, NEVER, seed=3) for _ in range(2))
    drawn = [
        each.draw([0], update, MODEL)[0].target
        for each, update in [
            (examples, 5),
            (again, 5),
            (examples, 6),
            (AugmentedExamples(samples, NOISE, NEVER, seed=4), 5),
        ]
    ]
    assert [torch.equal(drawn[0], other) for other in drawn[1:]] == [True, False, False]
    (stored,) = StoredExamples(samples).draw([1], 9, MODEL)
    assert torch.equal(stored.target, samples[1].target)
