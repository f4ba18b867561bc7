"""Metrics of rollouts against NumPy, and what must hold of them."""

import math

import numpy as np
import pytest
import torch

from cconv.domain import Box
from cconv.evaluation.rollout_metrics import kinetic_energies, momentum_drift, mse_n, speeds, squared_errors

BOX = Box((0.0, 0.0), (1.0, 2.0), (True, False))


def drift(generator, frames=6, particles=50):
    """Positions that move by less than half the box, in the box."""
    steps = 0.2 * (torch.rand(frames, particles, 2, generator=generator, dtype=torch.float64) - 0.5)
    return BOX.wrap(0.5 + steps.cumsum(dim=0))


def test_errors_are_those_of_numpy_with_every_image_tried(generator):
    positions, reference = drift(generator), drift(generator)
    images = [positions.numpy() + np.array([shift, 0.0]) - reference.numpy() for shift in (-1, 0, 1)]
    nearest = np.min(np.square(images), axis=0)
    errors = squared_errors(positions, reference, BOX)
    assert np.allclose(errors, nearest.mean(axis=(1, 2)))
    assert mse_n(errors, 4) == pytest.approx(nearest[:4].mean())


def test_a_frame_has_no_error_beside_itself_and_its_periodic_images(generator):
    positions = drift(generator)
    assert squared_errors(positions, positions, BOX).max() == 0
    assert squared_errors(positions + torch.tensor([3.0, 0.0]), positions, BOX).max() < 1e-25


def test_kinetic_energy_of_a_uniform_flow_is_known():
    times = torch.arange(5, dtype=torch.float64)[:, None, None]
    positions = BOX.wrap(torch.full((5, 40, 2), 0.5) + times * torch.tensor([0.3, 0.04]))
    energies = kinetic_energies(positions, BOX, particle_spacing=0.1, frame_dt=0.5)
    assert torch.allclose(energies, torch.full((4,), 0.1**2 * 40 * (0.6**2 + 0.08**2), dtype=torch.float64))
    assert torch.allclose(speeds(positions, BOX, 0.5), torch.tensor(math.hypot(0.6, 0.08), dtype=torch.float64))


def test_momentum_drifts_only_where_something_pushes(generator):
    masses = torch.rand(50, generator=generator)
    steady = torch.rand(50, 2, generator=generator, dtype=torch.float64)
    speeds = 0.1 * torch.rand(50, 2, generator=generator, dtype=torch.float64)
    times = torch.arange(5, dtype=torch.float64)[:, None, None]
    free = steady + times * speeds
    assert momentum_drift(BOX.wrap(free), masses, BOX).max() < 1e-12
    pushed = free + 0.01 * times**2 / 2 * torch.tensor([1.0, 0.0])
    expected = 0.01 * torch.arange(4) * masses.sum() / (masses[:, None] * (pushed[1] - pushed[0])).norm(dim=1).sum()
    assert torch.allclose(momentum_drift(pushed, masses, Box(BOX.lower, BOX.upper)), expected.double(), atol=1e-6)
    assert math.isfinite(float(momentum_drift(steady.expand(3, -1, -1), masses, BOX).max()))
