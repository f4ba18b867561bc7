"""The external force of a step: exact for a constant one, and targets still lead to the stored next frame."""

from dataclasses import replace

import pytest
import torch
from systems import periodic_frame, periodic_scene, window_of

from cconv.data.smoothed_force import smoothed_reverse_poiseuille
from cconv.domain import Box
from cconv.errors import ConfigError
from cconv.forces import ConstantForce, ReversePoiseuilleForce
from cconv.tasks import task_named
from cconv.tasks.external_force import WithExternalForce
from cconv.tasks.integrators import SemiImplicitEuler

EULER = SemiImplicitEuler()
SCENE = periodic_scene()
FORCES = {
    "constant": lambda positions: torch.tensor([0.7, -9.81], dtype=torch.float64).expand_as(positions),
    "reverse Poiseuille": smoothed_reverse_poiseuille(SCENE.box, 1.0, 0.05),
}


def with_walls(window, walls=5):
    return replace(window, particle_types=(torch.arange(len(window.masses)) < walls).long())


def free_fall(gravity, steps_per_frame, time_step, frames):
    """Frames of particles that only gravity moves, by the solver's semi-implicit Euler steps."""
    positions = torch.tensor([[0.2, 5.0], [0.7, 6.0]], dtype=torch.float64)
    velocities = torch.tensor([[1.0, 0.5], [-2.0, 0.0]], dtype=torch.float64)
    stored = [positions]
    for _ in range(frames - 1):
        for _ in range(steps_per_frame):
            velocities = velocities + time_step * gravity
            positions = positions + time_step * velocities
        stored.append(positions)
    return torch.stack(stored)


def window_along(positions, generator):
    """The window of two particles whose present is the third of some frames."""
    return replace(
        window_of(periodic_frame(generator), generator),
        positions=positions[:3],
        future=positions[3:],
        masses=torch.ones(2),
        particle_types=torch.zeros(2, dtype=torch.int64),
    )


def test_nothing_is_left_to_learn_of_a_free_fall(generator):
    """The second difference over frames of M steps is (M Δt)² g to rounding, not M (M + 1)/2 Δt² g."""
    gravity = torch.tensor([0.7, -9.81], dtype=torch.float64)
    positions = free_fall(gravity, steps_per_frame=100, time_step=3e-4, frames=4)
    scene = replace(SCENE, frame_dt=0.03, box=Box([0, 0], [10, 10]))
    window = window_along(positions, generator)
    integrator = WithExternalForce(EULER, FORCES["constant"])
    assert integrator.target(window, scene).abs().max() < 1e-12
    after = integrator.advance(window, torch.zeros(2, 2), scene)
    torch.testing.assert_close(after.present, positions[3], rtol=0, atol=1e-12)


@pytest.mark.parametrize("name", FORCES)
def test_its_target_leads_to_the_stored_next_frame(name, generator):
    window = with_walls(window_of(periodic_frame(generator), generator))
    window = replace(window, positions=window.positions.double(), future=window.future.double())
    window.future[0, :5] = 2 * window.positions[-1, :5] - window.positions[-2, :5]
    integrator = WithExternalForce(EULER, FORCES[name])
    target = integrator.target(window, SCENE)
    after = integrator.advance(window, target, SCENE)
    assert SCENE.box.displacement(after.present, window.future[0]).abs().max() < 1e-12
    learned = EULER.target(window, SCENE) - target
    expected = SCENE.frame_dt**2 * FORCES[name](window.present[5:])
    torch.testing.assert_close(learned, expected, rtol=0, atol=1e-15)
    assert learned.abs().max() > 1e-5


def test_a_force_that_is_not_finite_is_refused(generator):
    integrator = WithExternalForce(EULER, lambda positions: positions / 0)
    with pytest.raises(ConfigError, match="`force` must be finite"):
        integrator.target(window_of(periodic_frame(generator), generator), SCENE)


def with_force(force, travel, spacing=SCENE.particle_spacing):
    """A task to which the integrator adds the force, and a scene with it."""
    return task_named("acceleration", force_travel=travel), replace(SCENE, force=force, particle_spacing=spacing)


def test_the_force_of_the_scene_is_smoothed_over_the_distance_that_particles_travel(generator):
    task, scene = with_force(ReversePoiseuilleForce(1.5, 1.0), travel=0.4)
    window = with_walls(window_of(periodic_frame(generator), generator))
    learned = task_named("acceleration").target(window, scene) - task.target(window, scene)
    smooth = smoothed_reverse_poiseuille(SCENE.box, 1.5, 0.4 * SCENE.particle_spacing)
    expected = scene.frame_dt**2 * smooth(window.present[5:].double())
    torch.testing.assert_close(learned, expected, rtol=0, atol=1e-15)


def test_a_network_that_answers_nothing_predicts_a_free_fall_exactly(generator):
    gravity = torch.tensor([0.7, -9.81], dtype=torch.float64)
    positions = free_fall(gravity, steps_per_frame=100, time_step=3e-4, frames=6)
    task, scene = with_force(ConstantForce((0.7, -9.81)), travel=0.3)
    scene = replace(scene, frame_dt=0.03, box=Box([0, 0], [10, 10]))
    window = window_along(positions, generator)
    for stored in positions[3:]:
        window = task.integrator.advance(window, torch.zeros(2, 2), scene)
        torch.testing.assert_close(window.present, stored, rtol=0, atol=1e-11)


def test_a_scene_without_force_is_refused(generator):
    task = task_named("acceleration", force_travel=0.3)
    with pytest.raises(ConfigError, match="there is no external force, and an integrator is to add it"):
        task.target(window_of(periodic_frame(generator), generator), SCENE)


def test_a_field_has_no_integrator_that_could_add_a_force():
    with pytest.raises(ConfigError, match="'density_rate' is a field"):
        task_named("density_rate", force_travel=0.3)
