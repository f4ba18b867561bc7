"""Models that correct the step of a predictor."""

import json
from dataclasses import replace
from itertools import islice

import pytest
import torch
from systems import configured, periodic_frame, periodic_scene, window_of

from cconv import load_model
from cconv.data.window import join_windows
from cconv.errors import ConfigError
from cconv.evaluation.cost import counted_cost
from cconv.models.checkpoint import save_model
from cconv.models.model import ModelConfig, build_model
from cconv.rollout.rollout import advance, rollout
from cconv.study.declared.configuration import DEFAULTS
from cconv.study.running.problem import Problem
from cconv.tasks import task_named
from cconv.tasks.inputs import join_inputs
from cconv.tasks.samples import WindowSamples, make_step_sample

TASK, SCENE = task_named("acceleration"), periodic_scene()
LAYER = configured(
    DEFAULTS._replace(features=TASK.features, history=6), architecture="radial_net", layers=1, radial_terms=4
)


def model_for(task, window, generator, configuration=LAYER):
    samples = [make_step_sample(window, SCENE, task)]
    return build_model(configuration.network, task, ["velocity", "density"], SCENE, samples, generator).eval()


@pytest.fixture
def window(generator):
    return window_of(periodic_frame(generator), generator, future=4)


@pytest.fixture
def predictor(window, generator):
    return model_for(TASK, window, generator)


@pytest.fixture
def corrected(predictor, window, generator):
    return model_for(TASK.correcting(predictor), window, generator)


def without_answer(model):
    """The model with a network that answers zero."""
    for weights in model.network.parameters():
        weights.data.zero_()
    return model


def test_a_network_that_answers_zero_leaves_the_predictors_step(predictor, corrected, window):
    assert torch.equal(without_answer(corrected).predict_frame(window, SCENE), predictor.predict_frame(window, SCENE))


def test_the_network_sees_the_window_that_the_predictor_leads_to(predictor, corrected, window):
    seen = TASK.integrator.advance(window, predictor.predict_frame(window, SCENE), SCENE)
    found, expected = corrected.inputs(window, SCENE), TASK.inputs(seen, SCENE, corrected.config.features)
    assert torch.equal(found.positions, expected.positions)
    assert torch.equal(found.features.flat(), expected.features.flat())
    assert not torch.equal(found.positions, TASK.inputs(window, SCENE, corrected.config.features).positions)


def test_a_rollout_of_targets_comes_to_the_stored_frames(corrected, window):
    """The replay law: what the network has to answer, added to what the predictor has, leads to the next frame."""
    task = corrected.task

    def answer(current, scene):
        sample = make_step_sample(current, scene, task)
        assert sample.inputs.known is not None
        return sample.inputs.known + sample.target * sample.target_unit

    path = advance(answer, task.integrator, window, SCENE)
    for reached, stored in zip(islice(path, 4), window.future, strict=True):
        assert SCENE.box.displacement(reached.present, stored.double()).abs().max() < 1e-6 * SCENE.particle_spacing


def test_the_predictor_does_not_learn(corrected, window):
    sample = make_step_sample(window, SCENE, corrected.task)
    before = {name: value.clone() for name, value in corrected.predictor.state_dict().items()}
    optimizer = torch.optim.SGD(corrected.parameters(), 0.1)
    prediction = corrected(sample.inputs, corrected.geometry(sample.inputs))
    (prediction - corrected.standardize_target(sample.target)).square().mean().backward()
    optimizer.step()
    assert all(torch.equal(value, before[name]) for name, value in corrected.predictor.state_dict().items())
    assert all(parameter.grad is None for parameter in corrected.predictor.parameters())


def test_answers_are_differentiable_through_the_predictor(predictor, corrected, window):
    """A network that answers zero passes on the predictor's own derivative."""
    without_answer(corrected)
    derivatives = []
    for model in (predictor, corrected):
        moved = window.positions.clone().requires_grad_()
        answer = model.answer(replace(window, positions=moved), SCENE)
        derivatives.append(torch.autograd.grad(answer.square().sum(), moved)[0])
    assert derivatives[0].abs().max() > 0
    torch.testing.assert_close(derivatives[1], derivatives[0], rtol=1e-4, atol=1e-6)


def test_a_checkpoint_holds_the_predictor(corrected, window, tmp_path):
    save_model(corrected, tmp_path / "model", {})
    loaded = load_model(tmp_path / "model")
    assert loaded.num_parameters == corrected.num_parameters
    assert loaded.num_parameters > sum(each.numel() for each in loaded.network.parameters())
    assert torch.equal(loaded.predict_frame(window, SCENE), corrected.predict_frame(window, SCENE))
    frames = [next(islice(rollout(model, window, SCENE), 2, 3)).present for model in (corrected, loaded)]
    assert torch.equal(*frames)


def test_operations_of_the_predictor_count(predictor, corrected, window):
    inputs = corrected.inputs(window, SCENE)
    network = counted_cost(corrected.config.model_copy(update={"predictor": None}), inputs)
    assert counted_cost(corrected.config, inputs) == network + counted_cost(predictor.config, inputs)


def test_a_predictor_must_be_for_the_same_task_and_not_look_back_farther(predictor, corrected):
    with pytest.raises(ConfigError, match=r"`history` must be at least 6, the predictor's, got 3"):
        task_named("acceleration", history=3).correcting(predictor)
    config = corrected.config.model_dump()
    for wrong, message in (
        (config | {"predictor": config}, "must not have a predictor itself"),
        (config | {"predictor": config["predictor"] | {"dim": 3}}, "is for 3 dimensions"),
    ):
        with pytest.raises(ValueError, match=message):
            ModelConfig.model_validate(json.loads(json.dumps(wrong)))


def test_a_problem_has_models_with_and_without_it(predictor, window):
    samples = WindowSamples([window], SCENE, TASK)
    given = Problem(scene=SCENE, task=TASK, train_samples=samples, valid_samples=samples, predictor=predictor)
    with_it = given.build_model(configured(LAYER, with_predictor=True), 0)
    without = given.build_model(LAYER, 0)
    assert with_it.predictor is not None
    assert torch.equal(with_it.predictor.predict_frame(window, SCENE), predictor.predict_frame(window, SCENE))
    assert without.predictor is None
    drawn = [given.examples(LAYER.training, 0, model.task).draw([0], 0, model)[0] for model in (with_it, without)]
    torch.testing.assert_close(
        drawn[0].inputs.known + drawn[0].target * drawn[0].target_unit, drawn[1].target * drawn[1].target_unit
    )


def test_joined_windows_are_answered_as_each_alone(corrected, generator):
    windows = [window_of(periodic_frame(generator), generator, future=2) for _ in range(3)]
    answers = torch.cat([corrected.predict_frame(window, SCENE) for window in windows])
    torch.testing.assert_close(corrected.predict_frame(join_windows(windows), SCENE), answers, rtol=1e-5, atol=1e-8)
    joined = make_step_sample(join_windows(windows), SCENE, corrected.task)
    apart = [make_step_sample(window, SCENE, corrected.task) for window in windows]
    for found, one in zip(joined.inputs.separated(), apart, strict=True):
        torch.testing.assert_close(found.known, one.inputs.known, rtol=1e-5, atol=1e-8)
    assert torch.equal(join_inputs([one.inputs for one in apart]).known, torch.cat([one.inputs.known for one in apart]))
