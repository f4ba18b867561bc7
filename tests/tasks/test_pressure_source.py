"""The source of the pressure that networks are told: flows whose pressure is known."""

from dataclasses import replace

import pytest
import torch
from systems import periodic_frame, periodic_scene, window_of

from cconv.domain import Box
from cconv.tasks import task_named

TASK = task_named("acceleration", kernel="quintic_spline", history=2)
SPACING = 1 / 8
FLOWS = {  # gradient of the velocity per frame, and the source that Poisson's equation asks for
    "strain": ([[0.02, 0.0], [0.0, -0.02]], 2 * 0.02**2),
    "rotation": ([[0.0, -0.02], [0.02, 0.0]], -2 * 0.02**2),
    "shear": ([[0.0, 0.04], [0.0, 0.0]], 0.0),
    "uniform motion": ([[0.0, 0.0], [0.0, 0.0]], 0.0),
}


def source_amid(gradient):
    """What the particle in the middle of a lattice is told in a linear flow, in frames' times."""
    axis = (torch.arange(-8, 9, dtype=torch.float64) * SPACING).contiguous()
    present = torch.cartesian_prod(axis, axis)
    before = present - present @ torch.tensor(gradient, dtype=torch.float64).T - 0.01
    window = window_of(periodic_frame(torch.Generator().manual_seed(0)), torch.Generator().manual_seed(0), 2)
    window = replace(
        window,
        positions=torch.stack([before, present]),
        future=present[None],
        masses=torch.full((len(present),), SPACING**2),
        particle_types=torch.zeros(len(present), dtype=torch.long),
    )
    scene = replace(periodic_scene(), box=Box([-2, -2], [2, 2]))
    features = TASK.inputs(window, scene, TASK.features).features
    return float(features.named("pressure_source")[len(present) // 2])


@pytest.mark.parametrize("flow", FLOWS)
def test_the_source_is_the_square_of_the_velocity_gradient(flow):
    gradient, expected = FLOWS[flow]
    assert source_amid(gradient) == pytest.approx(expected, rel=0.02, abs=1e-8)
