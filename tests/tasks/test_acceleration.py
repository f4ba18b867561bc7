"""What a step is asked: second differences in frame units, of the fluid alone, with its walls beside it."""

from dataclasses import replace

import pytest
import torch
from systems import periodic_frame, periodic_scene, window_of, with_walls

from cconv.data.trajectory import ParticleType
from cconv.errors import ConfigError, ShapeError
from cconv.forces import ConstantForce, ReversePoiseuilleForce
from cconv.nn.kinds import Kinds
from cconv.study.declared.configuration import TaskConfig
from cconv.tasks import task_named
from cconv.tasks.samples import WindowSamples, make_step_sample

TASK = task_named("acceleration")


def sample_of(generator, **changes):
    window, scene = window_of(periodic_frame(generator), generator), periodic_scene()
    return make_step_sample(replace(window, **changes), scene, TASK), window, scene


def column(features, name):
    return features.vectors[:, [each == name for each in features.vector_names]]


def test_the_target_is_the_second_difference_in_spacings(generator):
    sample, window, scene = sample_of(generator)
    before, now, after = window.positions[-2].double(), window.present.double(), window.future[0].double()
    difference = scene.box.displacement(after, now) - scene.box.displacement(now, before)
    torch.testing.assert_close(sample.target.double(), difference / scene.particle_spacing, rtol=1e-5, atol=1e-5)
    assert sample.target_unit == scene.particle_spacing


def test_velocity_and_accelerations_are_the_history_newest_first(generator):
    sample, window, scene = sample_of(generator)
    positions = window.positions.double()
    steps = scene.box.displacement(positions[1:], positions[:-1]) / scene.particle_spacing
    features = sample.inputs.features
    torch.testing.assert_close(column(features, "velocity")[:, 0].double(), steps[-1], rtol=1e-4, atol=1e-5)
    expected = steps.diff(dim=0).flip(0).transpose(0, 1)
    torch.testing.assert_close(column(features, "accelerations").double(), expected, rtol=1e-4, atol=1e-5)
    assert features.vector_names[-1] == "velocity"  # networks that know it as differences leave out the last vector
    assert features.kinds == TASK.kinds(TASK.features) == Kinds(14, 7)


def test_a_uniform_motion_leaves_everything_but_the_velocity(generator):
    """Galilei: seen from a moving frame, accelerations, densities and target are the same."""
    still, window, scene = sample_of(generator)
    times = torch.arange(-5.0, 2)[:, None, None]
    drift = torch.tensor([0.03, -0.02])
    moving = replace(window, positions=window.positions + times[:6] * drift, future=window.future + times[6:] * drift)
    seen = make_step_sample(moving, scene, TASK)
    torch.testing.assert_close(seen.target, still.target, rtol=1e-3, atol=1e-4)
    for name in ("accelerations", "force"):
        pair = column(seen.inputs.features, name), column(still.inputs.features, name)
        torch.testing.assert_close(*pair, rtol=1e-3, atol=1e-4)
    velocities = column(seen.inputs.features, "velocity") - column(still.inputs.features, "velocity")
    torch.testing.assert_close(velocities[:, 0], (drift / scene.particle_spacing).expand(64, 2), rtol=1e-3, atol=1e-4)


def test_walls_of_particles_are_seen_but_not_asked_about(generator):
    types = torch.zeros(64, dtype=torch.int64)
    types[:8] = ParticleType.SOLID_WALL
    sample, _, _ = sample_of(generator, particle_types=types)
    assert sample.inputs.num_particles == 64
    assert sample.inputs.num_answers == len(sample.target) == 56
    kinds = sample.inputs.features.scalars[:, sample.inputs.features.scalar_names.index("particle_type")]
    assert torch.equal(kinds > 0, types > 0)
    assert sample.inputs.wall_positions is None


def test_boundary_points_are_walls_where_no_particle_is_one(generator):
    window = window_of(with_walls(periodic_frame(generator)), generator)
    inputs = TASK.inputs(window, periodic_scene(), TASK.features)
    assert inputs.wall_kinds == Kinds(0, 1)
    types = window.particle_types.clone()
    types[0] = ParticleType.MOVING_WALL
    assert TASK.inputs(replace(window, particle_types=types), periodic_scene(), TASK.features).wall_kinds is None


def test_a_force_is_in_spacings_per_frame_squared(generator):
    scene = replace(periodic_scene(), force=ConstantForce((0.0, -9.81)))
    inputs = TASK.inputs(window_of(periodic_frame(generator), generator), scene, TASK.features)
    expected = torch.tensor([0.0, -9.81 * scene.frame_dt**2 / scene.particle_spacing])
    torch.testing.assert_close(column(inputs.features, "force")[:, 0], expected.expand(64, 2))


def test_a_shorter_history_is_the_end_of_a_longer_one(generator):
    window, scene = window_of(periodic_frame(generator), generator), periodic_scene()
    short = task_named("acceleration", history=3).inputs(window, scene, TASK.features).features
    whole = TASK.inputs(window, scene, TASK.features).features
    assert torch.equal(column(short, "accelerations"), column(whole, "accelerations")[:, :1])


@pytest.mark.parametrize(("name", "history"), [("acceleration", 1), ("acceleration", 21), ("density_rate", 2)])
def test_a_history_that_the_task_cannot_have_is_refused(name, history):
    with pytest.raises(ConfigError, match="`history` must be"):
        task_named(name, history=history)


def test_a_window_that_is_too_short_is_refused(generator):
    window = window_of(periodic_frame(generator), generator, history=4)
    with pytest.raises(ShapeError, match="at least 6 frames up to the present, got 4"):
        TASK.inputs(window, periodic_scene(), TASK.features)


def test_samples_are_made_when_asked_for(generator):
    windows = [window_of(periodic_frame(generator), generator) for _ in range(3)]
    samples = WindowSamples(windows, periodic_scene(), TASK)
    assert len(samples) == 3
    assert torch.equal(samples[2].target, make_step_sample(windows[2], periodic_scene(), TASK).target)
    seen = [sample.window.positions for sample in samples[1:]]
    assert torch.equal(torch.stack(seen), torch.stack([window.positions for window in windows[1:]]))


def test_a_force_that_depends_on_the_place_is_that_of_each_particle(generator):
    window, scene = window_of(periodic_frame(generator), generator), periodic_scene()
    scene = replace(scene, force=ReversePoiseuilleForce(2.0, 1.0))
    forces = column(TASK.inputs(window, scene, TASK.features).features, "force")[:, 0]
    signs = torch.where(window.present[:, 1] % 1.0 > 0.5, -1.0, 1.0)
    assert {-1.0, 1.0} == set(signs.tolist())
    expected = torch.stack([2.0 * signs * scene.frame_dt**2 / scene.particle_spacing, torch.zeros(64)], dim=1)
    torch.testing.assert_close(forces, expected)


def test_types_are_ones_and_zeros_where_they_are_asked_for(generator):
    types = torch.arange(64) % 4
    sample, _, _ = sample_of(generator, particle_types=types)
    features = sample.inputs.features
    columns = [place for place, name in enumerate(features.scalar_names) if name == "type_one_hot"]
    assert torch.equal(features.scalars[:, columns], torch.eye(9)[types])
    assert "type_one_hot" not in TaskConfig(name="acceleration").taken
    assert "type_one_hot" in TaskConfig(name="acceleration", features=("velocity", "type_one_hot")).taken
