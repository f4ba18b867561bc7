"""Models know no units of the data: what they predict scales with lengths, masses and times, at every resolution."""

import math
from dataclasses import replace

import pytest
import torch
from systems import configured, model_of, periodic_frame, periodic_scene, with_walls

from cconv.data.trajectory import Frame, Scene
from cconv.domain import Box
from cconv.errors import ConfigError
from cconv.models.closed_form import solve_closed_form
from cconv.models.model import build_model
from cconv.tasks import task_named
from cconv.tasks.samples import make_sample

TASKS = ("density_rate", "density_gradient")
NETWORKS = [
    configured(layers=2, first_channels=4, kernel_size=3, message=message, architecture=architecture, radial_terms=5)
    for architecture in ("conv_net", "radial_net")
    for message in ("absolute", "difference")
]


def in_other_units(frame: Frame, scene: Scene, length: float, mass: float, time: float) -> tuple[Frame, Scene]:
    """The same frame and scene, told in units of which `length`, `mass` and `time` make one of the old ones."""
    walls = frame.boundary
    told = replace(
        frame,
        positions=length * frame.positions.double(),
        velocities=length / time * frame.velocities.double(),
        masses=mass * frame.masses.double(),
        boundary=None if walls is None else replace(walls, positions=length * walls.positions.double()),
    )
    box = Box(*([length * bound for bound in bounds] for bounds in (scene.box.lower, scene.box.upper)), True)
    return told, replace(
        scene, particle_spacing=length * scene.particle_spacing, frame_dt=time * scene.frame_dt, box=box
    )


@pytest.mark.parametrize(
    ("length", "mass", "time"), [(1e3, 1.0, 1.0), (1.0, 1e-3, 1.0), (1.0, 1.0, 60.0), (0.3, 7.0, 1e-4)]
)
@pytest.mark.parametrize("task", TASKS)
@pytest.mark.parametrize(
    "network", NETWORKS, ids=lambda network: f"{network.network.architecture}-{network.network.message}"
)
def test_predictions_change_by_the_factors_of_the_units(network, task, length, mass, time, generator):
    scene, frame = periodic_scene(), with_walls(periodic_frame(generator))
    train = [make_sample(frame, scene, task_named(task))]
    model = model_of(network, scene, task, train, generator)
    expected = model.predict_frame(frame, scene)
    density = mass / length**scene.dim
    expected = expected * (density / time if task == "density_rate" else density / length)
    found = model.predict_frame(*in_other_units(frame, scene, length, mass, time))
    assert expected.abs().max() > 0
    torch.testing.assert_close(found, expected, rtol=1e-4, atol=2e-5 * float(expected.abs().max()))


def flow(spacing: float, generator: torch.Generator) -> tuple[Frame, Scene]:
    """The same smooth flow of the same fluid, 1000 in density, in a periodic unit square at any resolution."""
    side = round(1 / spacing)
    frame, scene = periodic_frame(generator, side), periodic_scene(side)
    waves = 2 * math.pi * frame.positions
    velocities = torch.stack([waves[:, 0].sin() * waves[:, 1].cos(), (2 * waves[:, 1]).cos()], dim=1)
    return replace(frame, velocities=velocities, masses=1000 * frame.masses), scene


def own_error(model, frame, scene, task):
    """Mean squared error by the variance of the frame's own target."""
    target = make_sample(frame, scene, task_named(task))
    field = target.target.double() * target.target_unit
    difference = model.predict_frame(frame, scene) - field
    return float(difference.square().mean() / field.var(dim=0, correction=0).mean())


@pytest.mark.parametrize("density", [True, False])
def test_a_fit_at_one_resolution_holds_at_others(density, generator):
    network = configured(
        layers=1, architecture="radial_net", radial_terms=16, message="difference", relative_cutoff=2.0, density=density
    )
    frames = [flow(0.02, generator) for _ in range(3)]
    scene = frames[0][1]
    train = [make_sample(frame, scene, task_named("density_rate")) for frame, _ in frames]
    model = model_of(network, scene, "density_rate", train)
    solve_closed_form(model, train)
    errors = {spacing: own_error(model, *flow(spacing, generator), "density_rate") for spacing in (0.02, 0.025, 0.05)}
    assert max(errors.values()) < 1e-3, errors


def test_the_kernel_goes_with_the_spacing(generator):
    scene, frame = periodic_scene(), periodic_frame(generator)
    task = task_named("density_rate", relative_smoothing_length=1.5)
    model = build_model(configured(layers=1).network, task, task.features, scene, [make_sample(frame, scene, task)])
    assert model.config.relative_smoothing_length == 1.5
    assert model.kernel_at(0.02).smoothing_length == pytest.approx(0.03)
    assert model.kernel.smoothing_length == pytest.approx(1.5 / 8)


def test_a_periodic_box_too_narrow_for_the_cutoff_is_refused(generator):
    scene, frame = periodic_scene(4), periodic_frame(generator, 4)
    train = [make_sample(periodic_frame(generator), periodic_scene(), task_named("density_rate"))]
    model = model_of(configured(layers=1), periodic_scene(), "density_rate", train)
    with pytest.raises(ConfigError, match="at most half of every periodic axis, got 2.25 on axis 0 of length 4"):
        model.predict_frame(frame, scene)
