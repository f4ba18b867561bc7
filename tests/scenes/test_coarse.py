"""The solver run coarser: the same frames and space, velocity fields that are interpolated well, a flow that decays."""

import math
from dataclasses import replace

import pytest
import torch

from cconv.data.simulate import next_frame
from cconv.errors import ConfigError
from cconv.scenes import SCENES, scene_named
from cconv.scenes.coarse import coarse_state, coarser, coarser_scenes, velocities_at, with_slow_sound


@pytest.mark.parametrize("name", [name for name, scene in SCENES.items() if scene.dim == 2])
def test_a_coarser_scene_has_the_same_frames_in_fewer_and_larger_steps(name):
    scene = scene_named(name)
    coarse = coarser(scene, 2)
    assert coarse.particle_spacing == 2 * scene.particle_spacing
    assert coarse.frame_dt == pytest.approx(scene.frame_dt)
    assert coarse.steps_per_frame <= math.ceil(scene.steps_per_frame / 2)
    assert (coarse.viscosity, coarse.equation_of_state) == (scene.viscosity, scene.equation_of_state)
    inner = [each.walls.positions[each.walls.stored] - torch.tensor(each.corner) for each in (scene, coarse)]
    if len(inner[0]):
        widths = [walls.amax(dim=0) + walls.amin(dim=0) for walls in inner]
        torch.testing.assert_close(*widths, rtol=0, atol=2 * scene.particle_spacing)


def test_slow_sound_halves_the_steps_unless_viscosity_or_force_set_them():
    scene = scene_named("dam_break_2d")
    slow = with_slow_sound(scene)
    assert slow.frame_dt == pytest.approx(scene.frame_dt)
    assert slow.equation_of_state.sound_speed == scene.equation_of_state.sound_speed / 2
    assert slow.steps_per_frame < 0.6 * coarser(scene, 1).steps_per_frame  # acoustic: dt = 0.25 h / (c + u)
    assert with_slow_sound(replace(scene, viscosity=10.0, time_step=math.inf)) is None


def test_what_cannot_be_coarser_is_refused():
    with pytest.raises(ConfigError, match="`factor` must be positive"):
        coarser(scene_named("taylor_green_2d"), 0)
    with pytest.raises(ConfigError, match="periodic axis 2, twice the reach"):
        coarser(scene_named("reverse_poiseuille_3d"), 2)


def relaxed_vortices(factor):
    """A scene, a coarser one and its start, and points in the middle of the box."""
    scene = scene_named("taylor_green_2d", "small", particle_spacing=0.01, relaxation_steps=150)
    coarse = coarser(scene, factor)
    generator = torch.Generator().manual_seed(0)
    points = 0.3 + 0.4 * torch.rand(400, 2, generator=generator, dtype=torch.float64)
    return scene, coarse, coarse.initial_state(generator), points


def test_a_uniform_flow_is_interpolated_exactly():
    scene, coarse, state, points = relaxed_vortices(4)
    uniform = torch.tensor([0.7, -0.3], dtype=torch.float64)
    state.velocities[:] = uniform
    torch.testing.assert_close(velocities_at(points, scene, coarse, state), uniform.expand(400, 2))


def test_a_linear_flow_is_interpolated_with_an_error_that_falls_with_the_spacing():
    """Shepard's error is a part of slope times spacing on particles that are no lattice: of first order."""
    slope, errors = torch.tensor([[1.0, -2.0], [0.5, 1.5]], dtype=torch.float64), []
    for factor in (4, 2, 1):
        scene, coarse, state, points = relaxed_vortices(factor)
        state.velocities[:] = state.positions @ slope.T
        error = (velocities_at(points, scene, coarse, state) - points @ slope.T).norm(dim=1).square().mean().sqrt()
        assert error < 0.05 * slope.norm() * coarse.particle_spacing
        errors.append(float(error))
    assert errors[0] / errors[2] == pytest.approx(4, rel=0.3)


def test_points_count_from_the_corner_of_the_space_for_fluid():
    scene = scene_named("lid_driven_cavity_2d", "small", relaxation_steps=5)
    coarse = coarser(scene, 2)
    state = coarse.initial_state(torch.Generator().manual_seed(0))
    fluid = ~state.is_wall
    state.velocities[fluid] = state.positions[fluid] - torch.tensor(coarse.corner, dtype=torch.float64)
    points = torch.tensor([[0.3, 0.4], [0.7, 0.6]], dtype=torch.float64)
    found = velocities_at(points + torch.tensor(scene.corner), scene, coarse, state)
    torch.testing.assert_close(found, points, rtol=0, atol=0.1 * coarse.particle_spacing)


def test_far_from_the_fluid_there_is_no_flow():
    scene = scene_named("dam_break_2d", "small", relaxation_steps=5)
    coarse = coarser(scene, 2)
    state = coarse.initial_state(torch.Generator().manual_seed(0))
    state.velocities[:] = 1.0
    points = torch.tensor([[0.5, 0.5], [2.0, 1.2]], dtype=torch.float64)
    assert velocities_at(points, scene, coarse, state).tolist() == [[1.0, 1.0], [0.0, 0.0]]


@pytest.mark.integration
def test_a_coarse_flow_decays_at_the_analytic_rate_and_half_as_much():
    """Without a transport velocity 25² particles lose energy 52 % too fast, and the scene's own 50² 34 %."""
    scene, energies = scene_named("taylor_green_2d"), []
    coarse = coarser(scene, 2)
    solver, state = coarse.solver(), coarse.initial_state(torch.Generator().manual_seed(0))
    points = torch.rand(500, 2, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    for _ in range(26):
        energies.append(float(velocities_at(points, scene, coarse, state).square().sum()))
        state = next_frame(coarse, solver, state)
    rate = math.log(energies[0] / energies[-1]) / (25 * coarse.frame_dt)
    assert rate / (16 * math.pi**2 * scene.viscosity) - 1 == pytest.approx(0.52, abs=0.1)


@pytest.mark.parametrize("name", ["taylor_green_2d", "reverse_poiseuille_2d", "lid_driven_cavity_2d", "dam_break_2d"])
def test_coarser_and_coarser_scenes_can_all_be_begun_from_the_fine_one(name):
    """The fluid has the same mass to what a lattice can resolve, and a velocity field that is linear stays so."""
    scene = scene_named(name, "small", relaxation_steps=5)
    state = scene.initial_state(torch.Generator().manual_seed(0))
    fluid = ~state.is_wall
    state.velocities[fluid] = state.positions[fluid] - torch.tensor(scene.corner, dtype=torch.float64)
    scenes = list(coarser_scenes(scene))
    spacings = [each.particle_spacing / scene.particle_spacing for each in scenes]
    assert spacings
    assert min(spacings) > 1
    assert spacings == sorted(set(spacings))
    for coarse in scenes[:2]:
        begun = coarse_state(scene, coarse, state)
        moved = ~begun.is_wall
        assert float(begun.masses[moved].sum() / state.masses[fluid].sum()) == pytest.approx(1, abs=0.15)
        places = begun.positions[moved] - torch.tensor(coarse.corner, dtype=torch.float64)
        middle = ((places - 0.5).abs() < 0.2).all(dim=1)
        assert middle.any()
        torch.testing.assert_close(begun.velocities[moved][middle], places[middle], rtol=0, atol=0.3 / 12)


def test_no_scene_is_coarser_than_the_solver_can_fill():
    assert list(coarser_scenes(scene_named("reverse_poiseuille_3d", "small"))) == []
