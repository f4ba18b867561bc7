"""The one number of rollouts: 1 for plain ones, 0.5 for half of each measure, a stated worst for a divergence."""

from dataclasses import replace
from types import SimpleNamespace

import pytest
import torch
from systems import periodic_frame, periodic_scene, window_of

from cconv.errors import DataError
from cconv.evaluation.relaxed_rollouts import FlowErrors, flow_errors, mean_errors, relative_quality
from cconv.evaluation.rollout_errors import worst_error
from cconv.rollout.correctors import SPHRelaxation
from cconv.tasks import task_named
from cconv.tasks.samples import make_step_sample

SCENE, TASK = periodic_scene(10), task_named("acceleration")
PLAIN = FlowErrors(mse=1e-2, sinkhorn=1e-2, density=0.5)
STILL = SimpleNamespace(task=TASK, predict_frame=lambda window, scene: torch.zeros(len(window.present), 2))


@pytest.fixture
def start(generator):
    return make_step_sample(window_of(periodic_frame(generator, 10), generator, future=3), SCENE, TASK)


def test_plain_rollouts_have_one_and_half_of_every_measure_has_a_half():
    assert relative_quality(PLAIN, PLAIN, SCENE) == 1
    half = FlowErrors(mse=5e-3, sinkhorn=5e-3, density=0.25)
    assert relative_quality(half, PLAIN, SCENE) == pytest.approx(0.5, rel=1e-3)
    one_quarter = replace(PLAIN, sinkhorn=PLAIN.sinkhorn / 8)
    assert relative_quality(one_quarter, PLAIN, SCENE) == pytest.approx(0.5, rel=1e-3)


def test_errors_below_a_thousandth_of_a_spacing_do_not_count():
    small = FlowErrors(mse=1e-12, sinkhorn=0.0, density=0.0)
    assert relative_quality(small, replace(small, sinkhorn=1e-12), SCENE) == pytest.approx(1, rel=1e-3)


def test_means_are_of_each_measure():
    other = FlowErrors(mse=3e-2, sinkhorn=0.0, density=0.1)
    assert mean_errors([PLAIN, other]) == FlowErrors(mse=2e-2, sinkhorn=5e-3, density=0.3)


def test_a_rollout_of_targets_has_no_error_and_no_better_density_than_the_stored_one(start):
    window = start.window

    def replay(now, scene):
        return TASK.target(replace(now, future=window.future[now.frame - window.frame :]), scene)

    found, reason = flow_errors(SimpleNamespace(task=TASK, predict_frame=replay), start, ())
    assert reason is None
    assert found.mse < 1e-12
    assert found.sinkhorn < 1e-8
    relaxed, _ = flow_errors(STILL, start, [SPHRelaxation(0.02, 0.0, 5)])
    assert relaxed.density >= found.density > 0


def test_a_rollout_that_diverges_has_the_worst_values_in_what_it_does_not_reach(start):
    plain, _ = flow_errors(STILL, start, ())
    found, reason = flow_errors(STILL, start, [SPHRelaxation(1e4, 0.0, 1)])
    worst = worst_error(SCENE.box)
    assert "shifted a particle by" in reason
    assert found == FlowErrors(mse=worst, sinkhorn=2 * worst, density=1.0)
    assert relative_quality(found, plain, SCENE) > 10


def test_a_fluid_without_mass_has_no_density_at_rest(start):
    without = replace(start, window=replace(start.window, masses=torch.zeros_like(start.window.masses)))
    with pytest.raises(DataError, match="mean mass of the fluid must be positive"):
        flow_errors(STILL, without, ())
