"""One law: an integrator that is given its own target leads to the stored next frame."""

import itertools
from dataclasses import replace

import pytest
import torch
from systems import periodic_scene, periodic_trajectory

from cconv.data.trajectory import ParticleType
from cconv.data.window import window_at
from cconv.forces import ConstantForce
from cconv.rollout.rollout import advance
from cconv.tasks.integrators import CorrectedFall, SemiImplicitEuler

EULER, FALL = SemiImplicitEuler(), CorrectedFall()
WEIGHT = ConstantForce((30.0, -500.0))  # hundredths of a spacing per frame squared


@pytest.mark.parametrize("force", [None, WEIGHT])
@pytest.mark.parametrize("integrator", [EULER, FALL])
def test_replayed_targets_are_the_stored_frames(integrator, force, generator):
    """Also through periodic faces: the frames are independent of each other, so particles jump anywhere."""
    scene, trajectory = replace(periodic_scene(), force=force), periodic_trajectory(generator, num_frames=6)
    start = window_at(trajectory, 1, history=2, future=4)
    replayed = list(itertools.islice(advance(integrator.target, integrator, start, scene), 4))
    for window, stored in zip(replayed, trajectory.positions[2:], strict=True):
        error = scene.box.displacement(window.present.double(), stored.double())
        assert error.abs().max() < 1e-6
    assert [window.frame for window in replayed] == [2, 3, 4, 5]


def test_without_acceleration_particles_go_on(generator):
    scene, trajectory = periodic_scene(), periodic_trajectory(generator, num_frames=2)
    window = window_at(trajectory, 1, history=2, future=0)
    later = EULER.advance(window, torch.zeros(len(window.masses), 2), scene)
    steps = [scene.box.displacement(each[1].double(), each[0].double()) for each in (window.positions, later.positions)]
    assert torch.allclose(*steps, atol=1e-6)


def test_a_constant_acceleration_is_integrated_as_a_parabola():
    """The second difference of t² / 2 is 1."""
    scene = periodic_scene()
    scene = replace(scene, box=replace_periodic(scene.box))
    times = torch.arange(6, dtype=torch.float64)
    positions = (0.01 * times**2 / 2)[:, None, None].expand(6, 1, 2)
    window = replace(one_particle(scene), positions=positions[:2])
    path = itertools.islice(advance(lambda window, scene: torch.full((1, 2), 0.01), EULER, window, scene), 4)
    assert torch.allclose(torch.stack([window.present for window in path]), positions[2:])


def test_a_fall_is_that_of_the_force_during_a_frame(generator):
    """Networks are asked about the place that particles fall to, and the velocity that they then have."""
    scene, trajectory = replace(periodic_scene(), force=WEIGHT), periodic_trajectory(generator, num_frames=4)
    window = window_at(trajectory, 3, history=4, future=0)
    fall = scene.frame_dt**2 * torch.tensor(WEIGHT.acceleration, dtype=torch.float64)
    velocities = window.last_displacements(scene.box)
    later = FALL.before(window, scene)
    assert later.positions.shape == window.positions.shape
    torch.testing.assert_close(later.present, window.present + velocities + fall / 2)
    torch.testing.assert_close(later.last_displacements(scene.box), velocities + fall, atol=1e-6, rtol=0)
    assert FALL.advance(window, torch.zeros(64, 2), scene).frame == window.frame + 1


@pytest.mark.parametrize("integrator", [EULER, FALL])
@pytest.mark.parametrize("kind", [ParticleType.SOLID_WALL, ParticleType.MOVING_WALL])
def test_particles_that_are_no_fluid_repeat_their_last_displacement(kind, integrator, generator):
    scene, trajectory = replace(periodic_scene(), force=WEIGHT), periodic_trajectory(generator, num_frames=2)
    types = trajectory.particle_types.clone()
    types[:8] = kind
    window = window_at(replace(trajectory, particle_types=types), 1, history=2, future=0)
    later = integrator.advance(window, torch.ones(len(types) - 8, 2), scene)
    now = window.positions[:, :8].double()
    expected = scene.box.displacement(now[1], now[0])
    assert torch.allclose(scene.box.displacement(later.present[:8].double(), now[1]), expected, atol=1e-6)


def replace_periodic(box):
    return type(box)(box.lower, box.upper, False)


def one_particle(scene):
    return replace(
        window_at(periodic_trajectory(torch.Generator(), num_frames=2), 1, history=2, future=0),
        masses=torch.ones(1),
        particle_types=torch.zeros(1, dtype=torch.int64),
    )
