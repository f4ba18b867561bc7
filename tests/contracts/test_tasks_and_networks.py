"""What every pair of a task and a network must hold; a new one is held to it by being in its folder's list."""

import math
from copy import deepcopy
from dataclasses import replace
from typing import get_args

import pytest
import torch
from contracts.registered import registered
from simulated_device import simulated_device
from systems import configured, model_of, observed_and_sample, periodic_frame, periodic_scene, with_walls

from cconv.data.trajectory import Boundary, Frame
from cconv.forces import ConstantForce
from cconv.models.checkpoint import load_model, save_model
from cconv.models.model import build_model
from cconv.networks import ARCHITECTURES
from cconv.networks.network import NetworkSettings
from cconv.tasks import TASKS, task_named
from cconv.tasks.task import Task

CENTER = torch.tensor([0.5, 0.5])
PUSH = (500.0, -900.0)  # about a spacing per frame squared
pairs = pytest.mark.parametrize(("task", "architecture"), [(task, name) for task in TASKS for name in ARCHITECTURES])


def test_every_task_and_network_of_the_folders_is_in_its_list():
    assert registered("tasks", Task) == set(TASKS.values())
    assert registered("networks", NetworkSettings) == set(ARCHITECTURES.values())
    assert all(task.name == name for name, task in TASKS.items())


def walled_frame(generator):
    return with_walls(periodic_frame(generator))


def fresh(task, architecture, generator, **changes):
    """A small model with weights that are nowhere 0, and what it was standardised by: a frame or a window."""
    sizes = {"layers": 2, "first_channels": 4, "kernel_size": 3, "radial_terms": 5, "activation": "tanh"}
    scene = replace(periodic_scene(), force=ConstantForce(PUSH))
    observed, sample = observed_and_sample(walled_frame(generator), scene, task, generator)
    configuration = configured(**{"architecture": architecture} | sizes | changes)
    model = model_of(configuration, scene, task, [sample], generator)
    with torch.no_grad():
        for parameter in model.parameters():
            parameter.add_(0.1 * torch.randn(parameter.shape, generator=generator))
    return model, observed, scene


def moved(observed, points=lambda values: values, vectors=lambda values: values):
    """A frame or window whose points and vectors are mapped."""
    walls = observed.boundary
    changes = {
        "positions": points(observed.positions),
        "boundary": Boundary(positions=points(walls.positions), normals=vectors(walls.normals)),
    }
    if isinstance(observed, Frame):
        changes["velocities"] = vectors(observed.velocities)
    return replace(observed, **changes)


def close(found, expected):
    torch.testing.assert_close(found, expected, rtol=1e-3, atol=1e-4 * float(expected.abs().max()))


@pairs
def test_a_prediction_moves_with_the_scene(task, architecture, generator):
    model, observed, scene = fresh(task, architecture, generator)
    shift = torch.tensor([3.0, -2.0]) / 8
    elsewhere = moved(observed, lambda points: points + shift)
    close(
        model.predict_frame(elsewhere, replace(scene, box=replace_box(scene, shift))),
        model.predict_frame(observed, scene),
    )


def replace_box(scene, shift):
    box = scene.box
    lower, upper = (
        [bound + float(by) for bound, by in zip(corner, shift, strict=True)] for corner in (box.lower, box.upper)
    )
    return type(box)(lower, upper, box.periodic)


@pairs
def test_a_particle_beyond_a_periodic_face_is_the_one_within(task, architecture, generator):
    model, observed, scene = fresh(task, architecture, generator)
    beyond = torch.where(torch.rand(observed.positions.shape, generator=generator) > 0.5, 1.0, 0.0)
    outside = replace(observed, positions=observed.positions + beyond)
    wrapped = replace(outside, positions=scene.box.wrap(outside.positions.double()).float())
    close(model.predict_frame(wrapped, scene), model.predict_frame(observed, scene))


@pairs
def test_the_order_of_particles_and_wall_points_does_not_matter(task, architecture, generator):
    model, observed, scene = fresh(task, architecture, generator)
    order, walls = torch.randperm(64, generator=generator), torch.randperm(8, generator=generator)
    boundary = Boundary(positions=observed.boundary.positions[walls], normals=observed.boundary.normals[walls])
    changes = {name: getattr(observed, name)[order] for name in ("masses", "particle_types")}
    changes["positions"] = observed.positions[..., order, :]
    if isinstance(observed, Frame):
        changes["velocities"] = observed.velocities[order]
    shuffled = replace(observed, **changes, boundary=boundary)
    close(model.predict_frame(shuffled, scene), model.predict_frame(observed, scene)[order])


@pairs
def test_equivariance_is_as_the_network_says(task, architecture, generator):
    """A turn by a third of a right angle, in open space; a network that is not equivariant answers otherwise."""
    model, observed, scene = fresh(task, architecture, generator)
    cosine, sine = math.cos(math.pi / 6), math.sin(math.pi / 6)
    turn = torch.tensor([[cosine, -sine], [sine, cosine]])
    other = moved(observed, lambda points: (points - CENTER) @ turn.T + CENTER, lambda vectors: vectors @ turn.T)
    space = replace(scene, box=type(scene.box)(scene.box.lower, scene.box.upper, False))
    turned = replace(space, force=ConstantForce(tuple((turn @ torch.tensor(PUSH)).tolist())))
    expected = model.predict_frame(observed, space)
    if TASKS[task].output.vectors:
        expected = expected @ turn.T
    difference = (model.predict_frame(other, turned) - expected).abs().max() / expected.abs().max()
    assert difference < 1e-3 if model.settings.is_equivariant else difference > 1e-2


@pairs
def test_what_is_saved_predicts_the_same(task, architecture, generator, tmp_path):
    model, observed, scene = fresh(task, architecture, generator)
    save_model(model, tmp_path / "model", {})
    again = load_model(tmp_path / "model", task=task)
    assert again.config == model.config
    assert torch.equal(again.predict_frame(observed, scene), model.predict_frame(observed, scene))


@pairs
def test_every_parameter_gets_a_gradient(task, architecture, generator):
    for message in messages_of(architecture):
        _check_gradients(*fresh(task, architecture, generator, **message))


def messages_of(architecture):
    """Each kind of message that a network can be set to, as a hyperparameter; one without if there are none."""
    message = ARCHITECTURES[architecture].model_fields.get("message")
    return [{}] if message is None else [{"message": name} for name in get_args(message.annotation)]


def _check_gradients(model, observed, scene):
    inputs = model.inputs(observed, scene)
    model(inputs, model.geometry(inputs)).square().sum().backward()
    learned = [parameter for parameter in model.parameters() if parameter.numel()]
    assert all(parameter.grad is not None and parameter.grad.abs().sum() > 0 for parameter in learned)


@pairs
def test_optional_features_can_be_left_out(task, architecture, generator):
    scene, asked = periodic_scene(), task_named(task)
    observed, sample = observed_and_sample(walled_frame(generator), scene, task, generator)
    for left_out in asked.optional:
        features = [name for name in asked.features if name != left_out]
        settings = ARCHITECTURES[architecture](layers=1)
        model = build_model(settings, asked, features, scene, [sample], generator)
        assert left_out not in model.config.features
        assert model.predict_frame(observed, scene).shape == (64, asked.output.num_values(2))


@pairs
def test_any_device_gives_the_same_answers_and_gradients(task, architecture, generator):
    """A checkpoint made on one device answers on another, and learns there what it would have learned here."""
    model, observed, scene = fresh(task, architecture, generator)
    expected, learned = model.predict_frame(observed, scene), gradients(model, observed, scene)
    with simulated_device() as device:
        away = deepcopy(model).to(device)
        assert away.device == away.home == device
        close(away.predict_frame(observed, scene), expected)
        here = away.predict_frame(observed.to(device), scene)
        assert here.device == device
        close(here.cpu(), expected)
        found = {name: each.cpu() for name, each in gradients(away, observed.to(device), scene).items()}
    assert found.keys() == learned.keys()
    for name, gradient in learned.items():
        torch.testing.assert_close(found[name], gradient, rtol=1e-3, atol=1e-4 * float(gradient.abs().max()) + 1e-9)


def gradients(model, observed, scene):
    """Gradients of a loss by the names of the parameters."""
    model.zero_grad()
    model.answer(observed, scene).square().sum().backward()
    return {
        name: each.grad.clone() for name, each in model.named_parameters() if each.grad is not None and each.numel()
    }
