"""A cube falls into a box: walls that push along their normals keep it inside, and without them nothing does."""

import importlib.util
from pathlib import Path

import pytest
import torch

from cconv.models.model import Model, ModelConfig
from cconv.models.standardization import Standardization
from cconv.networks import ConvNetSettings

SCRIPT = Path(__file__).parents[2] / "experiments" / "falling_cube.py"
FRAMES, CELLS = 200, 3
GRAVITY = 9.81 * 0.02**2 / 0.05  # spacings per frame, squared


@pytest.fixture(scope="module")
def script():
    spec = importlib.util.spec_from_file_location("falling_cube", SCRIPT)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def simulator(push):
    """A single layer that answers the sum of the normals of the wall points around a particle, times `push`."""
    config = ModelConfig(
        task="position_correction",
        kernel="cubic_spline",
        relative_smoothing_length=1.0,
        dim=3,
        particle_spacing=0.05,
        frame_dt=0.02,
        history=2,
        features=("one", "velocity", "walls"),
        wall_scalars=0,
        wall_vectors=1,
        network=ConvNetSettings(layers=1),
    )
    model = Model(
        config, Standardization(torch.zeros(4), torch.ones(4)), Standardization(torch.zeros(3), torch.ones(3))
    )
    with torch.no_grad():
        for weights in model.parameters():
            weights.zero_()
        model.network.boundary_conv.filters.copy_(push * torch.eye(3).expand(4, 4, 4, 3, 3))
    return model.eval()


def test_walls_that_push_keep_the_cube_inside_and_carry_it(script):
    """It comes to rest where they push as gravity pulls, within their reach of 2.25 spacings."""
    states = list(script.states(simulator(0.5), FRAMES, CELLS))
    assert len(states) == FRAMES
    assert not any(state.outside for state in states)
    assert states[10].speed > 10 * GRAVITY / 2
    assert states[-1].speed < 1e-3
    assert 0 < states[-1].height < 2.25


def test_without_walls_that_push_it_falls_through_the_floor(script):
    """It leaves the box when its lowest particles have fallen through the room below it."""
    states = list(script.states(simulator(0.0), 30, CELLS))
    first = next(number for number, state in enumerate(states, start=1) if state.outside)
    below = (
        script.CELLS - CELLS - 3 + 0.5 + script.MARGIN
    )  # spacings from the lowest particles to the end of the margin
    fallen = [GRAVITY * frames * (frames + 1) / 4 for frames in (first - 1, first)]
    assert fallen[0] <= below < fallen[1]
