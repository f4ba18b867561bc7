"""Distances of sets of points and the surroundings of particles, each against an independent computation."""

import itertools
import math

import numpy as np
import pytest
import torch
from oracles.brute_force_neighbors import brute_force_pairs
from scipy.optimize import linear_sum_assignment, minimize
from scipy.spatial.distance import cdist

from cconv.domain import Box
from cconv.errors import ShapeError
from cconv.evaluation.particle_distribution import (
    FREE_SURFACE,
    MOST_NEIGHBORS,
    chamfer_distance,
    density_error,
    dirichlet_energy,
    neighbor_histogram,
    sinkhorn_divergence,
    speed_histogram,
    surroundings,
)
from cconv.sph.kernels import QuinticSpline

PERIODIC, OPEN = Box((-0.5, 1.0), (0.5, 3.0), (True, False)), Box((-0.5, 1.0), (0.5, 3.0))
BOXES = pytest.mark.parametrize("box", [PERIODIC, OPEN, Box((-0.5, 1.0), (0.5, 3.0), True)], ids=["x", "open", "both"])
LOWER, LENGTHS = torch.tensor([-0.5, 1.0], dtype=torch.float64), torch.tensor([1.0, 2.0], dtype=torch.float64)


def points(generator, count=50):
    return LOWER + LENGTHS * torch.rand(count, 2, generator=generator, dtype=torch.float64)


def distances(x, y, box):
    """Distances (N, M) with every image tried."""
    shifts = [
        (-length, 0.0, length) if wraps else (0.0,) for length, wraps in zip(box.lengths, box.periodic, strict=True)
    ]
    return np.min([cdist(x.numpy() + shift, y.numpy()) for shift in itertools.product(*shifts)], axis=0)


def entropic_cost(costs, epsilon):
    """Minimum of <P, c> + ε KL(P | a ⊗ b) over plans of equal weights, by a general minimiser."""
    n = len(costs)

    def value_and_slope(flat):
        plan = np.maximum(flat.reshape(n, n), 1e-300)
        logarithms = np.log(plan * n**2)
        return (plan * (costs + epsilon * logarithms)).sum(), (costs + epsilon * (logarithms + 1)).ravel()

    sums = np.concatenate([np.kron(np.eye(n), np.ones(n)), np.kron(np.ones(n), np.eye(n))[:-1]])
    marginals = {"type": "eq", "fun": lambda flat: n * (sums @ flat) - 1, "jac": lambda _: n * sums}
    start, bounds = np.full(n * n, 1 / n**2), [(0, None)] * n**2
    options = {"ftol": 1e-15, "maxiter": 1000}
    return minimize(
        value_and_slope, start, jac=True, bounds=bounds, constraints=marginals, method="SLSQP", options=options
    ).fun


@BOXES
def test_a_sinkhorn_divergence_is_made_of_three_minima(generator, box):
    x, y = points(generator, 5), points(generator, 5)
    costs = [np.square(distances(*pair, box)) for pair in ((x, y), (x, x), (y, y))]
    epsilon = 0.2 * costs[0].mean()
    between, *within = (entropic_cost(each, epsilon) for each in costs)
    assert sinkhorn_divergence(x, y, box, relative_epsilon=0.2) == pytest.approx(between - sum(within) / 2, rel=1e-4)


def test_a_sinkhorn_divergence_is_that_of_lagrangebench():
    """The value is of ott-jax 0.4.6 in float64 with its default ε and a threshold of 1e-10."""
    steps = np.arange(60)[:, None]
    x = steps * [0.6180339887498949, 0.7548776662466927] % 1.0 * [1.0, 2.0]
    y = x + 0.1 * np.sin(2 * np.pi * x[:, ::-1])
    found = sinkhorn_divergence(torch.tensor(x), torch.tensor(y), Box((0.0, 0.0), (1.0, 2.0), (True, False)))
    assert found == pytest.approx(0.004054294791296667, rel=1e-4)


@BOXES
def test_a_sinkhorn_divergence_of_small_epsilon_is_that_of_the_best_assignment(generator, box):
    ticks = torch.arange(4, dtype=torch.float64) / 4
    x = LOWER + LENGTHS * torch.cartesian_prod(ticks, ticks)
    moved = x + 0.05 * torch.randn(16, 2, generator=generator, dtype=torch.float64)
    y = box.wrap(moved[torch.randperm(16, generator=generator)])
    costs = np.square(distances(x, y, box))
    assigned = costs[linear_sum_assignment(costs)].mean()
    assert sinkhorn_divergence(x, y, box, relative_epsilon=1e-3) == pytest.approx(assigned, rel=1e-5)


@BOXES
@pytest.mark.parametrize("distance", [sinkhorn_divergence, chamfer_distance])
def test_distances_of_sets_know_neither_order_nor_side_nor_image(generator, box, distance):
    x, y = points(generator), points(generator)
    found = distance(x, y, box)
    assert found > 1e-3
    order = torch.randperm(len(x), generator=generator)
    images = LENGTHS * torch.tensor(box.periodic) * torch.randint(-2, 3, x.shape, generator=generator)
    for same in (distance(y, x, box), distance(x[order], y, box), distance(x + images, y, box)):
        assert same == pytest.approx(found, rel=1e-4)
    assert distance(x, x, box) == 0
    assert distance(x[order], x + images, box) < 1e-7


def test_a_sinkhorn_divergence_of_a_shift_in_open_space_is_its_square(generator):
    x = points(generator)
    assert sinkhorn_divergence(x, x + torch.tensor([0.3, 0.4]), OPEN) == pytest.approx(0.25, rel=1e-4)


def test_a_part_of_the_points_stands_for_all_of_them(generator):
    x = points(generator, 200)
    shifted = x + torch.tensor([0.03, 0.04])
    found = sinkhorn_divergence(x, shifted, OPEN, most_points=40)
    assert found == pytest.approx(0.0025, rel=1e-3)
    assert found == sinkhorn_divergence(x, shifted, OPEN, most_points=40)
    assert sinkhorn_divergence(x[:1].expand(9, 2), x[:1].expand(9, 2), PERIODIC) == 0
    with pytest.raises(ShapeError, match="`reference` must have shape"):
        sinkhorn_divergence(x, x[:3], OPEN)


@BOXES
def test_a_chamfer_distance_is_that_of_all_pairs(generator, box):
    x, y = points(generator, 40), points(generator, 60)
    table = distances(x, y, box)
    assert chamfer_distance(x, y, box) == pytest.approx(table.min(axis=0).mean() + table.min(axis=1).mean())


@BOXES
def test_surroundings_are_sums_over_all_pairs(generator, box):
    spacing, volumes = 1 / 6, torch.rand(50, generator=generator)
    positions, kernel = points(generator), QuinticSpline(spacing, 2)
    lengths = [length if wraps else None for length, wraps in zip(box.lengths, box.periodic, strict=True)]
    found = surroundings(positions, volumes, box, spacing)
    densities, gradients, neighbors = volumes.double() * kernel.value(torch.tensor(0.0)), np.zeros((50, 2)), [0] * 50
    for (i, j), displacement in brute_force_pairs(positions, 3 * spacing, lengths).items():
        distance = torch.tensor(math.hypot(*displacement), dtype=torch.float64)
        densities[i] += volumes[j] * kernel.value(distance)
        gradients[i] += float(volumes[j] * kernel.derivative(distance) / distance) * np.array(displacement)
        neighbors[i] += float(distance) <= 1.45 * spacing
    assert torch.allclose(found.densities, densities)
    assert np.allclose(found.gradients, gradients)
    assert found.neighbors.tolist() == neighbors


@pytest.mark.parametrize("dim", [2, 3])
def test_a_periodic_lattice_has_density_one_and_no_dirichlet_energy(dim):
    ticks = (torch.arange(8, dtype=torch.float64) + 0.5) / 8
    lattice, box = torch.cartesian_prod(*[ticks] * dim), Box([0] * dim, [1] * dim, True)
    found = surroundings(lattice, torch.full((8**dim,), 8.0**-dim), box, 1 / 8)
    assert density_error(found.densities) < 3e-3
    assert float(found.densities.max() - found.densities.min()) < 1e-12
    assert dirichlet_energy(found.gradients, 1 / 8) < 1e-20
    assert neighbor_histogram(found.neighbors)[{2: 8, 3: 18}[dim]] == 1
    denser = surroundings(lattice, torch.full((8**dim,), 1.1 * 8.0**-dim), box, 1 / 8)
    assert density_error(denser.densities) == pytest.approx(0.1, abs=4e-3)


def test_the_clamped_error_sees_compression_alone():
    densities = torch.tensor([0.5, 0.979, 0.99, 1.0, 1.2], dtype=torch.float64)
    assert density_error(densities, FREE_SURFACE) == pytest.approx((0.01 + 0.2) / 5)
    assert density_error(densities) == pytest.approx((0.5 + 0.021 + 0.01 + 0.2) / 5)


def test_the_dirichlet_energy_of_a_known_gradient_is_half_its_square():
    """The gradient of a plane wave on a lattice of volume 1 has the mean square a² k² / 2."""
    ticks = (torch.arange(10, dtype=torch.float64) + 0.5) / 10
    slopes = 0.1 * 2 * math.pi * torch.cos(2 * math.pi * torch.cartesian_prod(ticks, ticks)[:, 0])
    found = dirichlet_energy(torch.stack([slopes, 0 * slopes], dim=1), 0.1)
    assert found == pytest.approx(0.5 * (0.1 * 2 * math.pi) ** 2 / 2)


def test_histograms_hold_every_particle():
    shares = neighbor_histogram(torch.tensor([0, 2, 2, MOST_NEIGHBORS, 99]))
    assert (shares[0], shares[2], shares[-1], shares.sum()) == (0.2, 0.4, 0.4, 1)
    shares = speed_histogram(np.array([0.0, 0.4, 0.5, 1.0, 7.0]), np.linspace(0, 1, 3))
    assert shares.tolist() == [0.4, 0.6]
