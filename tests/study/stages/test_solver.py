"""The solver stands beside the recommended model where it can be measured, and else there is a reason."""

from types import SimpleNamespace

import pytest
from systems import periodic_frame, periodic_scene, window_of

from cconv.data.window import Windows
from cconv.scenes import scene_named
from cconv.study.stages import solver
from cconv.study.stages.solver import compare_with_solver
from cconv.tasks import task_named
from cconv.tasks.samples import WindowSamples

SESSION = SimpleNamespace(
    dataset=SimpleNamespace(scene=periodic_scene(), metadata={"case": "unknown"}),
    study=SimpleNamespace(cost=SimpleNamespace(threads=1)),
)


@pytest.fixture
def samples(generator):
    """Starts of rollouts of another scene than any that the solver knows."""
    given = WindowSamples(Windows([], 3, 1), periodic_scene(), task_named("acceleration", history=3))
    given.windows = [window_of(periodic_frame(generator), generator, 3, 2)]
    return given


def why_none(samples):
    found = compare_with_solver(SESSION, SimpleNamespace(checkpoints=[]), 1.0, samples)
    assert (found.points, found.rollouts, found.network_error) == ((), 0, None)
    return found.why_none


def test_a_scene_that_is_not_known_is_said(samples):
    assert why_none(samples) == "no scene has the case 'unknown' in 2 dimensions"


@pytest.mark.parametrize(
    ("name", "steps", "reason"),
    [
        ("taylor_green_2d", 10**7, "a single rollout of the solver would take minutes"),
        ("lid_driven_cavity_2d", 10, "the frame has 0 wall particles, and lid_driven_cavity_2d stores"),
    ],
)
def test_what_cannot_be_measured_is_said(name, steps, reason, samples, monkeypatch):
    simulated = scene_named(name, "small", steps_per_frame=steps)
    monkeypatch.setattr(solver, "find_scene", lambda metadata: (simulated, ""))
    assert why_none(samples).startswith(reason)
