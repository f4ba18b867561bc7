"""A coarser solver in the place of a model carries the particles of the data with its flow."""

from dataclasses import replace

import pytest
import torch

from cconv.data.trajectory import Scene
from cconv.data.window import Window, join_windows
from cconv.errors import ShapeError
from cconv.evaluation.rollout_errors import rollout_errors
from cconv.evaluation.solver_comparison import compared_rollouts, mean_error, measure_solvers
from cconv.rollout.coarse_solver_model import CoarseSolverModel
from cconv.rollout.rollout import Diverged
from cconv.rollout.solver_model import SolverModel
from cconv.scenes import scene_named
from cconv.scenes.coarse import coarser
from cconv.tasks import task_named
from cconv.tasks.samples import make_step_sample

TASK = task_named("acceleration", history=3)
FRAMES = 3


@pytest.fixture(scope="module")
def simulated():
    return scene_named("taylor_green_2d", "small", relaxation_steps=20, steps_per_frame=10)


def sample_of(simulated, velocity):
    """A window of particles of the scene, all with one velocity, that goes on so."""
    positions, _ = simulated.fluid(torch.Generator().manual_seed(0))
    times = torch.arange(-2, FRAMES + 1, dtype=torch.float64)[:, None, None] * simulated.frame_dt
    path = simulated.box.wrap(positions + times * torch.tensor(velocity, dtype=torch.float64))
    window = Window(
        positions=path[:3],
        future=path[3:],
        masses=torch.full((len(positions),), simulated.particle_spacing**2),
        particle_types=torch.zeros(len(positions), dtype=torch.int64),
        boundary=None,
        trajectory="0",
        frame=2,
    )
    facts = {"velocity_source": "stored", "mass_source": "stored", "missing": (), "force": None, "has_boundary": False}
    scene = Scene(
        name="vortices",
        dim=2,
        particle_spacing=simulated.particle_spacing,
        frame_dt=simulated.frame_dt,
        box=simulated.box,
        **facts,
    )
    return make_step_sample(window, scene, TASK)


@pytest.fixture(scope="module")
def sample(simulated):
    return sample_of(simulated, [0.5, -0.2])


def test_a_uniform_flow_carries_particles_exactly(simulated, sample):
    model = CoarseSolverModel(simulated, coarser(simulated, 2), TASK)
    found = rollout_errors(model.predict_frame, sample)
    assert found.diverged is None
    assert (found.errors**0.5 < 1e-6 * simulated.particle_spacing).all()


def test_it_begins_anew_from_another_start(simulated, sample):
    model, other = (CoarseSolverModel(simulated, coarser(simulated, 2), TASK) for _ in range(2))
    elsewhere = replace(sample.window, positions=simulated.box.wrap(sample.window.positions + 0.1))
    model.predict_frame(elsewhere, sample.scene)
    assert torch.equal(*(each.predict_frame(sample.window, sample.scene) for each in (model, other)))


def test_a_simulation_that_blows_up_is_a_rollout_that_diverged(simulated):
    sample = sample_of(simulated, [30.0, 0.0])  # faster than sound
    with pytest.raises(Diverged, match="the rollout diverged at frame 3: The simulation blew up"):
        CoarseSolverModel(simulated, coarser(simulated, 2), TASK).predict_frame(sample.window, sample.scene)


def test_solvers_are_measured_from_the_finest_on_until_one_is_fast_enough(simulated, sample):
    always, once = (measure_solvers(simulated, [sample], until_ms=ms, threads=1) for ms in (0.0, 1e9))
    assert [each.factor for each in once] == [1.0]
    usual, slow = ([each for each in always if each.sound_ratio == ratio] for ratio in (10, 5))
    assert len(usual) + len(slow) == len(always)
    for series in (usual, slow):
        assert [each.factor for each in series] == sorted({each.factor for each in always})
        assert [each.cost.num_particles for each in series] == [round(576 / each.factor**2) for each in series]
    assert all(each.cost.steps < simulated.steps_per_frame for each in always[1:])
    assert all(less.cost.steps <= more.cost.steps for less, more in zip(slow, usual, strict=True))
    errors = rollout_errors(SolverModel(simulated, TASK).predict_frame, sample).errors
    assert always[0].errors[0].errors == pytest.approx(errors)


def test_a_few_rollouts_are_compared_and_none_that_takes_too_long(simulated, sample):
    assert len(compared_rollouts(simulated, [sample] * 9)) == 4
    assert compared_rollouts(replace(simulated, steps_per_frame=100_000), [sample]) == []


def test_the_error_of_models_is_the_mean_over_them_and_over_the_rollouts(simulated, sample):
    model = SolverModel(simulated, TASK)
    error = rollout_errors(model.predict_frame, sample).error
    assert mean_error([model, model], [sample, sample]) == pytest.approx(error)


def test_solvers_refuse_windows_that_are_joined(simulated, sample):
    joined = join_windows([sample.window, sample.window])
    for solver in (SolverModel(simulated, TASK), CoarseSolverModel(simulated, coarser(simulated, 2), TASK)):
        with pytest.raises(ShapeError, match="one window on after another, got 2"):
            solver.predict_frame(joined, sample.scene)
