"""What every pair of a task and a network must hold; a new one is held to it by being in its folder's list."""

import math
from dataclasses import replace

import pytest
import torch
from contracts.registered import registered
from systems import model_of, periodic_frame, periodic_scene, with_walls

from cconv.data.trajectory import Boundary
from cconv.models.checkpoint import load_model, save_model
from cconv.models.model import build_model
from cconv.networks import ARCHITECTURES
from cconv.networks.network import NetworkSettings
from cconv.study.declared.configuration import DEFAULTS, configure
from cconv.tasks import TASKS, task_named
from cconv.tasks.samples import make_sample
from cconv.tasks.task import FieldTask

CENTER = torch.tensor([0.5, 0.5])
pairs = pytest.mark.parametrize(("task", "architecture"), [(task, name) for task in TASKS for name in ARCHITECTURES])


def test_every_task_and_network_of_the_folders_is_in_its_list():
    assert registered("tasks", FieldTask) == set(TASKS.values())
    assert registered("networks", NetworkSettings) == set(ARCHITECTURES.values())
    assert all(task.name == name for name, task in TASKS.items())


def walled_frame(generator):
    return with_walls(periodic_frame(generator))


def fresh(task, architecture, generator, **changes):
    """A small model with weights that are nowhere 0, and the frame that it was standardised by."""
    sizes = {"layers": 2, "first_channels": 4, "kernel_size": 3, "radial_terms": 5, "activation": "tanh"}
    of_network = ARCHITECTURES[architecture].model_fields
    parameters = {name: value for name, value in (sizes | changes).items() if name in of_network}
    scene, frame = periodic_scene(), walled_frame(generator)
    configuration = configure({"architecture": architecture} | parameters, DEFAULTS)
    model = model_of(configuration, scene, task, [make_sample(frame, scene, task_named(task))], generator)
    with torch.no_grad():
        for parameter in model.parameters():
            parameter.add_(0.1 * torch.randn(parameter.shape, generator=generator))
    return model, frame, scene


def close(found, expected):
    torch.testing.assert_close(found, expected, rtol=1e-3, atol=1e-4 * float(expected.abs().max()))


@pairs
def test_a_prediction_moves_with_the_scene(task, architecture, generator):
    model, frame, scene = fresh(task, architecture, generator)
    shift = torch.tensor([3.0, -2.0]) / 8
    box = replace_box(scene, shift)
    walls = replace(frame.boundary, positions=frame.boundary.positions + shift)
    moved = replace(frame, positions=frame.positions + shift, boundary=walls)
    close(model.predict_frame(moved, replace(scene, box=box)), model.predict_frame(frame, scene))


def replace_box(scene, shift):
    box = scene.box
    lower, upper = (
        [bound + float(by) for bound, by in zip(corner, shift, strict=True)] for corner in (box.lower, box.upper)
    )
    return type(box)(lower, upper, box.periodic)


@pairs
def test_a_particle_beyond_a_periodic_face_is_the_one_within(task, architecture, generator):
    model, frame, scene = fresh(task, architecture, generator)
    beyond = torch.where(torch.rand(frame.positions.shape, generator=generator) > 0.5, 1.0, 0.0)
    outside = replace(frame, positions=frame.positions + beyond)
    wrapped = replace(outside, positions=scene.box.wrap(outside.positions.double()).float())
    close(model.predict_frame(wrapped, scene), model.predict_frame(frame, scene))


@pairs
def test_the_order_of_particles_and_wall_points_does_not_matter(task, architecture, generator):
    model, frame, scene = fresh(task, architecture, generator)
    order, walls = torch.randperm(64, generator=generator), torch.randperm(8, generator=generator)
    boundary = Boundary(positions=frame.boundary.positions[walls], normals=frame.boundary.normals[walls])
    per_particle = ("positions", "velocities", "masses", "particle_types")
    shuffled = replace(frame, **{name: getattr(frame, name)[order] for name in per_particle}, boundary=boundary)
    close(model.predict_frame(shuffled, scene), model.predict_frame(frame, scene)[order])


@pairs
def test_equivariance_is_as_the_network_says(task, architecture, generator):
    """A turn by a third of a right angle, in open space; a network that is not equivariant answers otherwise."""
    model, frame, scene = fresh(task, architecture, generator)
    cosine, sine = math.cos(math.pi / 6), math.sin(math.pi / 6)
    turn = torch.tensor([[cosine, -sine], [sine, cosine]])

    def turned(points):
        return (points - CENTER) @ turn.T + CENTER

    walls = Boundary(positions=turned(frame.boundary.positions), normals=frame.boundary.normals @ turn.T)
    other = replace(frame, positions=turned(frame.positions), velocities=frame.velocities @ turn.T, boundary=walls)
    space = replace(scene, box=type(scene.box)(scene.box.lower, scene.box.upper, False))
    expected = model.predict_frame(frame, space)
    if TASKS[task].output.vectors:
        expected = expected @ turn.T
    difference = (model.predict_frame(other, space) - expected).abs().max() / expected.abs().max()
    assert difference < 1e-3 if model.settings.is_equivariant else difference > 1e-2


@pairs
def test_what_is_saved_predicts_the_same(task, architecture, generator, tmp_path):
    model, frame, scene = fresh(task, architecture, generator)
    save_model(model, tmp_path / "model", {})
    again = load_model(tmp_path / "model", task=task)
    assert again.config == model.config
    assert torch.equal(again.predict_frame(frame, scene), model.predict_frame(frame, scene))


@pairs
@pytest.mark.parametrize("message", ["absolute", "difference"])
def test_every_parameter_gets_a_gradient(task, architecture, message, generator):
    model, frame, scene = fresh(task, architecture, generator, message=message)
    inputs = model.inputs(frame, scene)
    model(inputs, model.geometry(inputs)).square().sum().backward()
    learned = [parameter for parameter in model.parameters() if parameter.numel()]
    assert all(parameter.grad is not None and parameter.grad.abs().sum() > 0 for parameter in learned)


@pairs
def test_optional_features_can_be_left_out(task, architecture, generator):
    scene, frame = periodic_scene(), walled_frame(generator)
    asked = task_named(task)
    sample = make_sample(frame, scene, asked)
    for left_out in asked.optional:
        features = [name for name in asked.features if name != left_out]
        settings = ARCHITECTURES[architecture](layers=1)
        model = build_model(settings, asked, features, scene, [sample], generator)
        assert left_out not in model.config.features
        assert model.predict_frame(frame, scene).shape == (64, asked.output.num_values(2))
