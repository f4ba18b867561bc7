"""Pushforward: a model learns to come back from where its own rollout leads."""

import pytest
import torch
from systems import configured, model_of, periodic_frame, periodic_scene, window_of

from cconv.models.relaxation import Relaxation
from cconv.rollout.rollout import rollout
from cconv.tasks import task_named
from cconv.tasks.samples import WindowSamples
from cconv.training.augmentation import RandomWalkNoise
from cconv.training.examples import AugmentedExamples
from cconv.training.unroll import Pushforward, pushed, unrolled

TASK, SCENE = task_named("acceleration"), periodic_scene()


@pytest.fixture
def samples(generator):
    return WindowSamples([window_of(periodic_frame(generator), generator, future=4)], SCENE, TASK)


@pytest.fixture
def model(samples, generator):
    return model_of(configured(layers=1), SCENE, "acceleration", list(samples), generator)


def test_there_are_no_steps_before_it_begins_and_all_numbers_after(generator):
    pushforward = Pushforward(most=3, begins=0.5)
    assert {pushforward.steps(0.49, generator) for _ in range(20)} == {0}
    assert {pushforward.steps(0.5, generator) for _ in range(60)} == {0, 1, 2, 3}
    assert {Pushforward(most=3, begins=0.0).steps(0.0, generator) for _ in range(20)} == {0}


def test_the_window_is_that_of_the_models_rollout_and_the_target_leads_back(samples, model):
    start = samples.windows[0]
    (window,) = pushed(model, [start], SCENE, [2])
    path = rollout(model, start, SCENE)
    next(path)
    assert torch.equal(window.present, next(path).present)
    assert not window.present.requires_grad
    following = TASK.integrator.advance(window, TASK.target(window, SCENE), SCENE)
    off = SCENE.box.displacement(following.present, start.future[2].double())
    assert off.abs().max() < 1e-9


def test_a_rollout_that_diverges_stays_where_it_came(samples):
    class Broken:
        task = TASK

        def predict_frame(self, window, scene):
            return torch.full((64, 2), torch.nan)

    (window,) = pushed(Broken(), [samples.windows[0]], SCENE, [3])
    assert torch.equal(window.present, samples.windows[0].present)


def test_a_relaxed_model_learns_from_where_its_relaxed_rollout_leads(samples, model):
    start, relaxed = samples.windows[0], model.relaxed_by(Relaxation(alpha=0.02, beta=0.3, loops=2))
    (window,) = pushed(relaxed, [start], SCENE, [1])
    assert torch.equal(window.present, next(rollout(relaxed, start, SCENE)).present)
    assert not torch.equal(window.present, next(rollout(model, start, SCENE)).present)


def test_examples_are_never_pushed_beyond_what_is_stored(samples, model):
    examples = AugmentedExamples(samples, RandomWalkNoise(0.0), Pushforward(20, 0), seed=0)
    frames = {sample.frame for update in range(1, 40) for sample in examples.draw([0], update, model, share=1.0)}
    assert frames == {5, 6, 7, 8}  # at least one frame of future is left to lead to


@pytest.fixture
def equivariant(samples, generator):
    """A model whose targets have one scale along all axes."""
    return model_of(configured(architecture="radial_net", layers=2), SCENE, "acceleration", list(samples), generator)


def test_examples_hold_what_the_model_takes_as_samples_with_all_features_have_it(samples, model):
    """No sum over neighbours is taken for a feature that the model does without."""
    model.config = model.config.model_copy(update={"features": ("one", "accelerations", "velocity")})
    examples = AugmentedExamples(samples, RandomWalkNoise(0.0), Pushforward(0, 0), seed=0)
    (sample,) = examples.draw([0], 1, model)
    drawn = sample.inputs.features
    assert set(drawn.names) == {"one", "accelerations", "velocity"}
    assert torch.equal(drawn.flat(), samples[0].inputs.features.select(drawn.names).flat())


def errors_of(model, sample, steps):
    """Root of the mean squared error of each step, in the units of the data."""
    unit = model.target_scale[0] * sample.target_unit
    return [
        float((prediction - target).detach().square().mean().sqrt() * unit)
        for [(_, prediction, target, _)] in unrolled(model, sample, steps, lambda each: model.geometry(each.inputs))
    ]


def test_errors_of_unrolled_steps_are_those_of_the_rollout(samples, equivariant):
    """What a later step answers wrongly is how far the rollout is from the stored frame."""
    start = samples.windows[0]
    path = [window.present for window, _ in zip(rollout(equivariant, start, SCENE), range(3), strict=False)]
    off = SCENE.box.displacement(torch.stack(path), start.future[:3].double())
    expected = off.square().mean((1, 2)).sqrt().tolist()
    assert errors_of(equivariant, samples[0], 3) == pytest.approx(expected, rel=1e-4)


def test_gradients_of_unrolled_steps_are_those_of_finite_differences(samples, equivariant):
    """The first step's part in the later error comes by way of positions, densities and neighbours' directions."""
    model, sample = equivariant, samples[0]
    weights = next(model.parameters())

    def last_error():
        *_, [(_, prediction, target, _)] = unrolled(model, sample, 3, lambda each: model.geometry(each.inputs))
        return (prediction - target).square().mean()

    (gradient,) = torch.autograd.grad(last_error(), weights)
    direction, small = gradient.sign(), 1e-3
    with torch.no_grad():
        after, before = (last_error() for sign in (1, -2) if weights.add_(sign * small * direction) is not None)
    assert float((after - before) / (2 * small)) == pytest.approx(float((gradient * direction).sum()), rel=1e-3)


def test_unrolled_steps_of_a_relaxed_model_are_those_of_its_rollout(samples, equivariant):
    """The window that the second step is asked about is relaxed; the first step's part in its error still counts."""
    relaxed, start = equivariant.relaxed_by(Relaxation(alpha=0.02, beta=0.3, loops=2)), samples.windows[0]
    path = rollout(relaxed, start, SCENE)
    window = next(path)
    answer = relaxed.predict_frame(window, SCENE)
    following = TASK.integrator.advance(window, answer, SCENE)
    off = SCENE.box.displacement(following.present, start.future[1].double())
    found = errors_of(relaxed, samples[0], 2)
    assert found[1] == pytest.approx(float(off.square().mean().sqrt()), rel=1e-4)
    *_, [(_, prediction, target, _)] = unrolled(relaxed, samples[0], 2, lambda each: relaxed.geometry(each.inputs))
    once, twice = (
        torch.autograd.grad(loss, next(relaxed.parameters()), retain_graph=True)[0]
        for loss in ((prediction - target).square().mean(), (prediction - target.detach()).square().mean())
    )
    assert not torch.allclose(once, twice)


def test_unrolling_ends_where_nothing_is_stored_and_where_it_diverges(samples, model):
    assert len(errors_of(model, samples[0], 9)) == 4
    with torch.no_grad():
        for weights in model.parameters():
            weights.fill_(torch.nan)
    assert len(errors_of(model, samples[0], 9)) == 1
