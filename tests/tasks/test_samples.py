import pytest
import torch
from systems import kernel, periodic_frame, periodic_scene

from cconv.errors import ConfigError
from cconv.tasks import TASKS, task_named
from cconv.tasks.features import fluid_state
from cconv.tasks.samples import make_sample


@pytest.mark.parametrize("task", ["density_rate", "density_gradient"])
def test_shape_and_dtype(task, generator):
    scene = periodic_scene()
    sample = make_sample(periodic_frame(generator), scene, task_named(task), "run", 7)
    assert sample.target.shape == (64, TASKS[task].output.num_values(2))
    assert sample.target.dtype == torch.float32
    assert (sample.trajectory, sample.frame) == ("run", 7)


def test_density_rate_is_the_change_of_density_along_the_motion(generator):
    """D2 against a central difference of D1 over a small step of the particles."""
    scene, frame, step = periodic_scene(), periodic_frame(generator), 1e-5
    densities = []
    for sign in (-1, 1):
        moved = fluid_state(frame, scene.box, kernel(scene))
        shifted = type(frame)(
            positions=moved.positions + sign * step * moved.velocities, velocities=moved.velocities,
            masses=moved.masses, particle_types=frame.particle_types, boundary=None,
        )  # fmt: skip
        densities.append(fluid_state(shifted, scene.box, kernel(scene)).densities)
    expected = (densities[1] - densities[0]) / (2 * step)
    sample = make_sample(frame, scene, task_named("density_rate"))
    assert sample.target_unit == 100.0  # rest density 1 in a frame's time of 0.01
    torch.testing.assert_close(100 * sample.target[:, 0].double(), expected, atol=1e-4, rtol=1e-4)


def test_unknown_task_is_refused_with_the_nearest():
    with pytest.raises(ConfigError, match="Did you mean 'density_rate'"):
        task_named("density_rat")
