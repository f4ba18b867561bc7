"""The time of the solver for a stored frame."""

import statistics

import pytest
import torch
from systems import still_window

from cconv.evaluation import solver_cost
from cconv.evaluation.solver_cost import measure_solver
from cconv.scenes import scene_named


def still(name):
    """A small scene, and a window in which its particles do not move."""
    scene = scene_named(name, "small", relaxation_steps=5, steps_per_frame=3)
    fluid, _ = scene.fluid(torch.Generator().manual_seed(0))
    walls = scene.walls.positions[scene.walls.stored]
    return scene, still_window(walls, fluid)


@pytest.mark.parametrize("name", ["taylor_green_2d", "dam_break_2d"])
def test_all_steps_of_a_frame_are_timed_with_fixed_threads(name):
    scene, start = still(name)
    threads = torch.get_num_threads()
    cost = measure_solver(scene, start, threads=1, repeats=4)
    assert torch.get_num_threads() == threads
    assert len(cost.turns_ms) == 4
    assert cost.ms_per_frame == pytest.approx(statistics.median(cost.turns_ms))
    assert 0 < min(cost.turns_ms) <= cost.ms_low <= cost.ms_high <= max(cost.turns_ms)
    assert (cost.steps, cost.threads, cost.num_particles) == (3, 1, int(start.is_fluid.sum()))


def test_the_first_turn_is_a_warm_up_and_every_turn_begins_at_the_same_state(monkeypatch):
    scene, start = still("taylor_green_2d")
    seconds, states = iter([9.0, 0.001, 0.003, 0.002]), []
    monkeypatch.setattr(solver_cost, "time_solver", lambda scene, state: (states.append(state), next(seconds))[1])
    cost = measure_solver(scene, start, threads=1, repeats=3)
    assert cost.turns_ms == pytest.approx((1, 3, 2))
    assert cost.ms_per_frame == pytest.approx(2)
    assert all(state is states[0] for state in states)
