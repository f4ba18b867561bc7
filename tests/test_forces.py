"""External forces: what is declared is what acts, with the symmetries that its name says."""

import json

import pytest
import torch

from cconv.errors import ConfigError
from cconv.forces import FORCES, ConstantForce, ReversePoiseuilleForce, force_declared

EXAMPLES = [
    (ConstantForce((0.5, -9.81)), 2),
    (ConstantForce((0.0, 0.0, 1.0)), 3),
    (ReversePoiseuilleForce(1.5, 2.0), 2),
    (ReversePoiseuilleForce(1.0, 3.0), 3),
]
examples = pytest.mark.parametrize(("force", "dim"), EXAMPLES)


def points(dim, generator, count=200):
    """Random points in a cube around the origin, none of them where a force changes its sign."""
    return 8 * torch.rand(count, dim, generator=generator, dtype=torch.float64) - 4.0003


def test_every_force_has_an_example():
    assert {type(force) for force, _ in EXAMPLES} == set(FORCES.values())


@examples
def test_a_declaration_written_as_json_is_read_as_the_same_force(force, dim):
    assert force_declared(json.loads(json.dumps(force.declaration())), dim) == force


@examples
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_no_acceleration_is_larger_than_the_magnitude(force, dim, dtype, generator):
    accelerations = force(points(dim, generator).to(dtype))
    assert (accelerations.shape, accelerations.dtype) == ((200, dim), dtype)
    assert float(accelerations.norm(dim=1).max()) == pytest.approx(force.largest)


def test_numbers_alone_are_a_constant_force(generator):
    force = force_declared([0, -1.5], 2)
    assert force == ConstantForce((0, -1.5))
    assert torch.equal(force(points(2, generator)), torch.tensor([[0, -1.5]], dtype=torch.float64).expand(200, 2))


@pytest.mark.parametrize("dim", [2, 3])
def test_reverse_poiseuille_is_odd_about_its_middle_and_periodic(dim, generator):
    """Odd about the middle of a period and about its ends, so that its mean over a period is 0."""
    force, positions = ReversePoiseuilleForce(1.5, 2.0), points(dim, generator)
    period, mirror = torch.zeros(dim, dtype=torch.float64), torch.ones(dim, dtype=torch.float64)
    period[1], mirror[1] = 2.0, -1.0
    assert torch.equal(force(positions + period), force(positions))
    assert torch.equal(force(mirror * positions), -force(positions))
    assert torch.equal(force(mirror * positions + period), -force(positions))
    assert not force(positions)[:, 1:].any()


def test_reverse_poiseuille_is_the_sign_of_the_published_flow():
    """LagrangeBench: 1 along x where y < 1, -1 where y > 1, in a box of height 2."""
    heights = torch.tensor([0.0, 1e-6, 0.5, 0.999999, 1.000001, 1.5, 1.999999])
    found = ReversePoiseuilleForce(1.0, 2.0)(torch.stack([torch.zeros(7), heights], dim=1))
    assert found[:, 0].tolist() == [1, 1, 1, 1, -1, -1, -1]


@pytest.mark.parametrize(
    ("declared", "message"),
    [
        ([1.0], "a constant force must have 2 numbers"),
        ([1.0, True], "a constant force must have 2 numbers"),
        ([1.0, float("nan")], "a constant force must have 2 numbers"),
        ({"name": "constant", "acceleration": 1.0}, "a constant force must have 2 numbers"),
        ("down", "a force must be 2 numbers, or its `name` and parameters, got 'down'"),
        ({"magnitude": 1.0}, "or its `name` and parameters"),
        ({"name": ["constant"]}, "or its `name` and parameters"),
        ({"name": "reverse_poiseuile"}, "Did you mean 'reverse_poiseuille'"),
        ({"name": "reverse_poiseuille", "magnitude": 1.0}, "must have magnitude and height"),
        ({"name": "reverse_poiseuille", "magnitude": 1.0, "height": 2.0, "x": 1}, "must have magnitude and height"),
        ({"name": "reverse_poiseuille", "magnitude": "1", "height": 2.0}, "`magnitude` .* must be a positive number"),
        ({"name": "reverse_poiseuille", "magnitude": 1.0, "height": 0.0}, "`height` .* must be a positive number"),
    ],
)
def test_a_force_that_cannot_be_is_refused_with_the_reason(declared, message):
    with pytest.raises(ConfigError, match=message):
        force_declared(declared, 2)


def test_reverse_poiseuille_needs_two_dimensions():
    with pytest.raises(ConfigError, match="2 or 3 dimensions, got 1"):
        force_declared({"name": "reverse_poiseuille", "magnitude": 1.0, "height": 2.0}, 1)


@pytest.mark.parametrize("deviation", [0.01, 0.1, 0.4, 3.0])
def test_the_smoothed_reverse_poiseuille_force_is_the_mean_over_displacements(deviation):
    """For any deviation, also of many heights, and with the symmetries of the force."""
    force = ReversePoiseuilleForce(1.5, 2.0)
    heights = torch.linspace(-3, 3, 25, dtype=torch.float64)
    positions = torch.stack([torch.zeros_like(heights), heights], dim=1)
    mean, offsets = torch.zeros_like(heights), torch.linspace(-6, 6, 24_001, dtype=torch.float64)
    weights = torch.exp(-(offsets**2) / 2)
    for place, height in enumerate(heights):
        moved = height + deviation * offsets
        values = force(torch.stack([torch.zeros_like(moved), moved], dim=1))[:, 0]
        mean[place] = (weights * values).sum() / weights.sum()
    found = force.smoothed(deviation)
    torch.testing.assert_close(found(positions)[:, 0], mean, rtol=0, atol=2e-3)
    assert (found(positions)[:, 1] == 0).all()
    odd = found(-positions)[:, 0]
    torch.testing.assert_close(odd, -found(positions)[:, 0], rtol=0, atol=1e-12)
    later = positions + torch.tensor([0.0, 2.0])
    torch.testing.assert_close(found(later), found(positions), rtol=0, atol=1e-12)


def test_a_force_smoothed_over_nothing_is_itself_and_a_constant_one_always():
    positions = torch.rand(9, 2, dtype=torch.float64)
    for force in (ConstantForce((0.5, -9.81)), ReversePoiseuilleForce(1.5, 2.0)):
        assert torch.equal(force.smoothed(0.0)(positions), force(positions))
    assert torch.equal(ConstantForce((0.5, -9.81)).smoothed(0.7)(positions), ConstantForce((0.5, -9.81))(positions))
