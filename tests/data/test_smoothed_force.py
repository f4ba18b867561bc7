"""Laws of forces over a frame: constants, symmetry, periodicity, closed forms of smoothed functions."""

import math

import pytest
import torch

from cconv import Box
from cconv.data.smoothed_force import evaluated, smoothed, smoothed_reverse_poiseuille, travel_deviation
from cconv.errors import ConfigError, ShapeError

BOX = Box([0.0, 0.0], [1.0, 2.0], True)
DEVIATION = 0.025


def column(count=401, low=0.0, high=2.0):
    """Positions at one x and evenly spaced y."""
    y = torch.linspace(low, high, count, dtype=torch.float64)
    return torch.stack([torch.full_like(y, 0.3), y], dim=1)


def opposite_halves(positions):
    """The force of reverse Poiseuille flow in its box, 1.5 before smoothing."""
    lower = BOX.wrap(positions)[:, 1] < 1
    return 1.5 * torch.stack([torch.where(lower, 1.0, -1.0).to(positions), torch.zeros_like(positions[:, 0])], dim=1)


def waves(positions):
    """sin(2πy) along x, and cos(2πx) cos(4πy) along y."""
    x, y = 2 * math.pi * positions.T
    return torch.stack([torch.sin(y), torch.cos(x) * torch.cos(2 * y)], dim=1)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_a_constant_force_is_its_own_mean(dtype):
    gravity = torch.tensor([0.3, -9.81], dtype=dtype)
    mean = smoothed(lambda positions: gravity.expand_as(positions), (0.1, 0.2), nodes=9)(column().to(dtype))
    assert mean.dtype == dtype
    torch.testing.assert_close(mean, gravity.expand_as(mean))


def test_without_travel_the_mean_is_the_force_itself():
    assert torch.equal(smoothed(waves, (0.0, 0.0))(column()), waves(column()))


def test_waves_become_lower_by_the_normal_distributions_factor():
    """The mean of cos(k(x + σz)) is exp(-(kσ)²/2) cos(kx), along each axis."""
    positions = column()
    k, (along_x, along_y) = 2 * math.pi, (0.05, 0.1)
    factors = [math.exp(-((k * along_y) ** 2) / 2), math.exp(-((k * along_x) ** 2 + (2 * k * along_y) ** 2) / 2)]
    found = smoothed(waves, (along_x, along_y), nodes=24)(positions)
    torch.testing.assert_close(found, waves(positions) * torch.tensor(factors).double(), rtol=0, atol=1e-5)


def test_an_odd_force_stays_odd():
    y = column(low=-1.0, high=1.0)
    for force in (smoothed(opposite_halves, (0.0, 0.1), nodes=7), smoothed_reverse_poiseuille(BOX, 1.5, 0.1)):
        up, down = (force(torch.stack([y[:, 0], 1 + sign * y[:, 1]], dim=1)) for sign in (1, -1))
        inside = (y[:, 1].abs() - y[:, 1].abs().round()).abs() > 1e-9  # a jump itself has no side
        torch.testing.assert_close(up[inside], -down[inside], rtol=0, atol=1e-12)


def test_a_periodic_force_stays_periodic():
    for force in (smoothed(opposite_halves, (0.0, 0.1), nodes=7), smoothed_reverse_poiseuille(BOX, 1.5, 0.1)):
        there = force(column(400, 0.0025, 1.9975) + torch.tensor([3.0, -4.0]))
        torch.testing.assert_close(there, force(column(400, 0.0025, 1.9975)), rtol=0, atol=1e-9)


@pytest.mark.parametrize(("nodes", "tolerance"), [(64, 0.031), (256, 0.008)])
def test_the_closed_form_of_reverse_poiseuille_flow_is_the_numerical_mean(nodes, tolerance):
    """Up to a share of the jump of 2 · 1.5."""
    exact = smoothed_reverse_poiseuille(BOX, 1.5, DEVIATION)(column(2001))
    found = smoothed(opposite_halves, (0.0, DEVIATION), nodes=nodes)(column(2001))
    assert (found - exact).abs().max() < tolerance * 3
    assert (exact[:, 1] == 0).all()


def test_the_closed_form_is_the_published_one():
    y, scale = column()[:, 1], math.sqrt(2) * DEVIATION
    published = torch.erf(y / scale) + torch.erf((y - 2) / scale) - torch.erf((y - 1) / scale)
    found = smoothed_reverse_poiseuille(BOX, 1.0, DEVIATION)(column())[:, 0]
    torch.testing.assert_close(found, published, rtol=0, atol=1e-12)


def test_far_from_jumps_it_is_the_force_itself():
    positions = torch.tensor([[0.1, 0.5], [0.1, 1.5]], dtype=torch.float64)
    found = smoothed_reverse_poiseuille(BOX, 1.5, DEVIATION)(positions)
    torch.testing.assert_close(found, opposite_halves(positions))


@pytest.mark.parametrize(
    ("deviations", "published"), [((0.0359, 0.000685), 0.02538), ((0.0739, 0.0014, 0.00114), 0.0427)]
)
def test_the_travelled_distance_is_the_published_one(deviations, published):
    assert travel_deviation(deviations) == pytest.approx(published, rel=1e-3)


@pytest.mark.parametrize("wrap", [evaluated, lambda force, positions: smoothed(force, (0.1, 0.0))(positions)])
def test_forces_that_cannot_be_are_refused_in_one_line(wrap):
    positions = column(5)
    with pytest.raises(ShapeError, match=r"`force\(positions\)` must have shape \(5, 2\), got \(5,\)"):
        wrap(lambda positions: positions[:, 0], positions)
    with pytest.raises(ShapeError, match="`force` must return a tensor, got a list"):
        wrap(lambda positions: positions.tolist(), positions)
    with pytest.raises(ConfigError, match="got NaN or infinity for .* of 5 positions") as error:
        wrap(lambda positions: positions / (positions - positions[0]), positions)
    assert "\n" not in str(error.value)


def test_settings_that_cannot_be_are_refused():
    with pytest.raises(ConfigError, match="`deviations` must be numbers from 0 on, got -1"):
        smoothed(waves, (0.0, -1.0))
    with pytest.raises(ConfigError, match="`nodes` must be at least 1"):
        smoothed(waves, (0.0, 1.0), nodes=0)
    with pytest.raises(ConfigError, match="at most a tenth of the box"):
        smoothed_reverse_poiseuille(BOX, 1.0, 0.3)
    with pytest.raises(ConfigError, match="must be periodic along its second axis"):
        smoothed_reverse_poiseuille(Box([0, 0], [1, 2], [True, False]), 1.0, 0.01)
    with pytest.raises(ShapeError, match="`positions` must have shape"):
        smoothed(waves, (0.1, 0.1))(torch.zeros(3, 3))
