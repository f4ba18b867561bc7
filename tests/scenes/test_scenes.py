"""What the published scenes must be, and what is special to some."""

import math

import pytest
import torch

from cconv.errors import ConfigError
from cconv.scenes import scene_named
from cconv.scenes.relaxed import glass, relaxed
from cconv.scenes.walls import Walls, lattice, walls_around

PUBLISHED = {  # LagrangeBench: fluid, stored walls, moving among them, dx, dt, viscosity, lengths of the box
    "taylor_green_2d": (2500, 0, 0, 0.02, 4e-4, 0.01, (1, 1)),
    "taylor_green_3d": (8000, 0, 0, 0.314159, 5e-3, 0.02, (2 * math.pi,) * 3),
    "reverse_poiseuille_2d": (3200, 0, 0, 0.025, 5e-4, 0.1, (1, 2)),
    "reverse_poiseuille_3d": (8000, 0, 0, 0.05, 1e-3, 0.1, (1, 2, 0.5)),
    "lid_driven_cavity_2d": (2500, 208, 56, 0.02, 4e-4, 0.01, (1.12, 1.12)),
    "lid_driven_cavity_3d": (6912, 1248, 360, 1 / 24, 9e-4, 0.01, (1.25, 1.25, 0.5)),
    "dam_break_2d": (5000, 740, 0, 0.02, 3e-4, 5e-5, (5.586, 2.22)),
}


@pytest.mark.parametrize("name", PUBLISHED)
def test_published_sizes_are_those_of_lagrangebench(name, generator):
    scene = scene_named(name, relaxation_steps=1)
    fluid, _ = scene.fluid(generator)
    moving = scene.walls.velocities.any(dim=1)
    counts = len(fluid), int(scene.walls.stored.sum()), int((moving & scene.walls.stored).sum())
    settings = scene.particle_spacing, scene.time_step, scene.viscosity
    assert counts == PUBLISHED[name][:3]
    assert settings == pytest.approx(PUBLISHED[name][3:6], rel=1e-5)
    assert scene.box.lengths == pytest.approx(PUBLISHED[name][6], abs=1e-6)
    assert scene.steps_per_frame == 100


def test_relaxing_spreads_what_was_shaken(generator):
    from cconv import Box

    box = Box((0.0, 0.0), (1.0, 1.0), periodic=True)
    settings = {"box": box, "walls": Walls.none(2), "spacing": 0.05}
    start = lattice((20, 20), 0.05, (0.0, 0.0))
    solver = scene_named("taylor_green_2d", particle_spacing=0.05).solver()

    def spread(steps):
        positions = relaxed(start, **settings, generator=torch.Generator().manual_seed(0), steps=steps)
        zeros = torch.zeros(400)
        state = solver.initial_state(positions, torch.zeros(400, 2), zeros + 0.0025, zeros, zeros.bool())
        return float(state.densities.std())

    assert spread(300) < 0.2 * spread(1)


def test_glass_fills_a_box_evenly(generator):
    lower, upper = torch.zeros(3, dtype=torch.float64), torch.tensor([1.5, 2.0, 1.0], dtype=torch.float64)
    particles = glass(lower, upper, 0.1, generator, steps=20)
    assert len(particles) == pytest.approx(3000, rel=0.02)
    assert (particles >= lower).all()
    assert (particles <= upper).all()
    left = particles[particles[:, 0] < 0.75]
    assert len(left) == pytest.approx(1500, rel=0.04)


def test_walls_are_three_layers_around_the_cells():
    walls = walls_around((4, 5), 0.1, (0.0, 0.0))
    assert len(walls) == 10 * 11 - 20
    assert int(walls.stored.sum()) == 6 * 7 - 20
    open_sides = walls_around((4, 5), 0.1, (0.0, 0.0), [False, True])
    assert len(open_sides) == 4 * 6


@pytest.mark.integration
def test_drop_follows_the_ellipse_of_monaghan():
    """Half axes a, b of a drop with velocity A (-x, y): da/dt = -A a, db/dt = A b, dA/dt = A² (a² - b²)/(a² + b²)."""
    scene = scene_named("free_drop_2d", "small", particle_spacing=0.05)
    generator = torch.Generator().manual_seed(0)
    solver, state = scene.solver(), scene.initial_state(generator)
    a, b, rate, time, step = 1.0, 1.0, 1.0, 0.0, 1e-4
    while time < 0.8:
        a, b = a - step * rate * a, b + step * rate * b
        rate, time = rate + step * rate**2 * (a**2 - b**2) / (a**2 + b**2), time + step
    for _ in range(round(0.8 / scene.time_step)):
        state = solver.step(state, scene.time_step)
    # Second moments of an even ellipse are a quarter of its squared half axes.
    measured = 2 * state.positions.std(dim=0)
    assert measured.tolist() == pytest.approx([a, b], rel=0.04)


def test_cuboid_has_boundary_points_with_normals_into_the_box():
    points, normals = scene_named("cuboid_3d", "small").boundary
    axes = normals.abs().argmax(dim=1)[:, None]
    places = points.gather(1, axes)[:, 0]
    expected = torch.where(normals.gather(1, axes)[:, 0] > 0, 0.0, 1.2).double()
    torch.testing.assert_close(places, expected)
    assert torch.equal(normals.norm(dim=1), torch.ones(len(normals)).double())
    assert ((points >= 0) & (points <= 1.2 + 1e-12)).all()


def test_trajectories_of_the_cuboid_differ_in_viscosity():
    scene = scene_named("cuboid_3d", "small")
    drawn = [scene.draw_viscosity(torch.Generator().manual_seed(seed)) for seed in range(20)]
    assert len(set(drawn)) == 20
    assert 0.1 * scene.viscosity <= min(drawn) < 0.3 * scene.viscosity
    assert 0.6 * scene.viscosity < max(drawn) <= scene.viscosity


def test_settings_that_cannot_be_are_refused():
    for arguments, message in (
        (("dam_break_3d",), "Did you mean 'dam_break_2d'"),
        (("dam_break_2d", "tiny"), "published, small"),
    ):
        with pytest.raises(ConfigError, match=message):
            scene_named(*arguments)
    for settings, message in (
        ({"time_step": 1.0}, "time_step"),
        ({"viscosity": -1.0}, "viscosity"),
        ({"steps_per_frame": 0}, "steps_per_frame"),
    ):
        with pytest.raises(ConfigError, match=message):
            scene_named("taylor_green_2d", **settings)
    with pytest.raises(ConfigError, match=r"must divide the length 1 .* take 0\.0303"):
        scene_named("taylor_green_2d", particle_spacing=0.03).fluid(torch.Generator())


def test_a_spacing_of_ones_own_gets_a_time_step_of_its_own():
    assert scene_named("taylor_green_2d", particle_spacing=0.01).time_step < 4e-4
