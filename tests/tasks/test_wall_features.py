"""What a network is told of walls: how near they are, which way leads from them, and how they move."""

from dataclasses import replace

import pytest
import torch
from systems import configured, model_of, periodic_frame, periodic_scene, window_of, with_walls

from cconv.data.trajectory import Boundary, ParticleType
from cconv.domain import Box
from cconv.models.model import absent_features
from cconv.tasks import task_named
from cconv.tasks.samples import make_step_sample

TASK = task_named("acceleration", history=2)
SPACING = 1 / 8
REACH = 2 * SPACING  # support of the cubic spline at h = dx


def open_scene():
    """The unit square without periodic axes."""
    return replace(periodic_scene(), box=Box([0, 0], [1, 1]))


def flat_wall(normal, tangent, spacing):
    """Wall points (B, 2) on the line through the middle of the square that is orthogonal to a normal."""
    steps = torch.arange(-40, 41, dtype=torch.float64)[:, None]
    return 0.5 + spacing * steps * tangent + 0 * normal


def window_with(fluid, boundary, walls=None, generator=None):
    """Two equal frames of fluid (M, 2), and of wall particles (S, 2) after it."""
    present = fluid if walls is None else torch.cat([fluid, walls])
    types = torch.full((len(present),), int(ParticleType.SOLID_WALL))
    types[: len(fluid)] = ParticleType.FLUID
    window = window_of(periodic_frame(torch.Generator().manual_seed(0)), torch.Generator().manual_seed(0), 2)
    return replace(
        window,
        positions=torch.stack([present, present]),
        future=present[None],
        masses=torch.full((len(present),), SPACING**2),
        particle_types=types,
        boundary=None if boundary is None else Boundary(positions=boundary, normals=None),
    )


def told(window, scene):
    """Distances (M,) and normals (M, 2) that the fluid is given."""
    features = TASK.inputs(window, scene, TASK.features).features
    return (features.named(name)[window.is_fluid].double() for name in ("wall_distance", "wall_normal"))


@pytest.mark.parametrize("angle", [0.0, 0.4, 2.0])
def test_above_a_flat_wall_the_distance_is_the_height_and_the_normal_points_away(angle):
    turn = torch.tensor([angle], dtype=torch.float64)
    tangent, normal = torch.cat([turn.cos(), turn.sin()]), torch.cat([-turn.sin(), turn.cos()])
    heights = torch.linspace(0.01, 3 * SPACING, 40, dtype=torch.float64)
    along = torch.linspace(0, SPACING / 2, 40, dtype=torch.float64)[:, None]
    fluid = 0.5 + heights[:, None] * normal + along * tangent
    wall = flat_wall(normal, tangent, SPACING / 8)
    distances, normals = told(window_with(fluid, wall), open_scene())
    expected = (heights / REACH).clamp(max=1)
    torch.testing.assert_close(distances, expected, rtol=0, atol=0.25 / 8)
    torch.testing.assert_close(normals, (1 - expected)[:, None] * normal, rtol=0, atol=0.25 / 8)


def test_the_normal_hardly_turns_along_a_wall_of_particles():
    """Particles lie a spacing apart; the direction from the nearest one would turn by 45 degrees between them."""
    tangent, normal = torch.eye(2, dtype=torch.float64)
    along = torch.linspace(0, SPACING, 50, dtype=torch.float64)[:, None]
    fluid = 0.5 + 0.5 * SPACING * normal + along * tangent
    _, normals = told(window_with(fluid, None, flat_wall(normal, tangent, SPACING)), open_scene())
    tilts = torch.atan2(normals @ tangent, normals @ normal).abs()
    assert float(torch.rad2deg(tilts.max())) < 20


def test_both_fade_out_at_the_reach_of_the_kernel():
    wall = torch.full((1, 2), 0.5, dtype=torch.float64)
    fluid = wall + torch.tensor([[REACH - 1e-6, 0.0], [REACH + 1e-6, 0.0], [0.9 * REACH, 0.0]])
    distances, normals = told(window_with(fluid, wall), open_scene())
    torch.testing.assert_close(distances, torch.tensor([1.0, 1.0, 0.9], dtype=torch.float64), rtol=0, atol=1e-4)
    torch.testing.assert_close(normals[:, 0], torch.tensor([0, 0, 0.1], dtype=torch.float64), rtol=0, atol=1e-4)


def test_a_distance_is_that_of_brute_force_across_periodic_faces(generator):
    scene = periodic_scene()
    wall, fluid = (torch.rand(count, 2, generator=generator, dtype=torch.float64) for count in (7, 60))
    distances, normals = told(window_with(fluid, wall), scene)
    apart = fluid[:, None] - wall
    nearest = (apart - apart.round()).norm(dim=2).amin(dim=1)
    torch.testing.assert_close(distances, (nearest / REACH).clamp(max=1), rtol=1e-5, atol=1e-6)
    assert bool(normals[distances == 1].any()) is False
    assert bool((normals[distances < 1].norm(dim=1) > 0).all())


def test_wall_particles_and_boundary_points_at_the_same_places_tell_the_same(generator):
    wall, fluid = (torch.rand(count, 2, generator=generator, dtype=torch.float64) for count in (7, 60))
    of_points, of_particles = (told(window_with(fluid, *each), open_scene()) for each in ((wall,), (None, wall)))
    for found, expected in zip(of_particles, of_points, strict=True):
        assert torch.equal(found, expected)


def test_wall_particles_are_at_the_wall_and_have_no_normal(generator):
    wall, fluid = (torch.rand(count, 2, generator=generator, dtype=torch.float64) for count in (7, 60))
    window = window_with(fluid, None, wall)
    features = TASK.inputs(window, open_scene(), TASK.features).features
    assert not features.named("wall_distance")[~window.is_fluid].any()
    assert not features.named("wall_normal")[~window.is_fluid].any()


@pytest.mark.parametrize("walled", [True, False])
def test_a_scene_without_walls_has_no_wall_inputs(walled, generator):
    frame, scene = periodic_frame(generator), periodic_scene()
    sample = make_step_sample(window_of(with_walls(frame) if walled else frame, generator), scene, TASK)
    absent = absent_features(TASK, TASK.features, [sample])
    wall_features = {"wall_distance", "wall_normal"}
    assert absent == {"particle_type", "type_one_hot", "force", "accelerations"} | (set() if walled else wall_features)


def test_no_walls_are_searched_for_models_that_are_not_told_of_them(generator):
    window = window_of(with_walls(periodic_frame(generator)), generator)
    assert TASK.inputs(window, periodic_scene(), ("one", "velocity")).features.names == ("one", "velocity")


def lid_window(generator, lid_step, drift=0.0):
    """A frame whose upper row of particles is a wall that slides, while all else drifts, along x."""
    frame = periodic_frame(generator)
    types = torch.where(frame.positions[:, 1] > 1 - SPACING, int(ParticleType.MOVING_WALL), int(ParticleType.FLUID))
    steps = torch.where(types == ParticleType.FLUID, drift, lid_step)[:, None] * torch.tensor([1.0, 0.0])
    still = replace(window_of(frame, generator, 2), particle_types=types)
    return replace(still, positions=torch.stack([still.present - steps, still.present]))


def test_difference_messages_know_the_velocity_of_a_lid_relative_to_the_fluid(generator):
    """So a lid that slides needs no feature of its own: only its motion relative to the fluid is seen."""
    scene, seed = periodic_scene(), generator.initial_seed()
    windows = [
        lid_window(torch.Generator().manual_seed(seed), *steps) for steps in ((0.0, 0.0), (0.05, 0.0), (0.08, 0.03))
    ]
    samples = [make_step_sample(window, scene, TASK) for window in windows]
    configuration = configured(architecture="radial_net", layers=1, message="mixed", radial_terms=5)
    model = model_of(configuration, scene, "acceleration", samples, generator)
    with torch.no_grad():
        for parameter in model.parameters():
            parameter.add_(0.1 * torch.randn(parameter.shape, generator=generator))
    at_rest, sliding, drifting = (model.predict(sample.inputs) for sample in samples)
    near = lid_window(torch.Generator().manual_seed(seed), 0.0).present
    near = near[near[:, 1] <= 1 - SPACING][:, 1] > 1 - 2 * SPACING
    changed = (sliding - at_rest).norm(dim=1)
    assert float(changed[near].min()) > 0
    torch.testing.assert_close(drifting, sliding, rtol=1e-3, atol=1e-3 * float(sliding.abs().max()))
