"""Compiled sums against the plain ones, which are the reference."""

import pytest
import torch

from cconv.domain import Box
from cconv.errors import ConfigError, ShapeError
from cconv.neighbors import radius_graph
from cconv.sph import KERNELS, CubicSpline, density, density_gradient, density_rate, kernel_named, velocity_gradient
from cconv.sph.compiled import CompiledSums


def fluid(dim, dtype, generator, periodic=True, particles=120):
    """Positions with two particles at one place and one far from all, velocities, unequal masses, and the box."""
    positions = torch.rand(particles, dim, dtype=torch.float64, generator=generator)
    positions[1] = positions[0]
    if not periodic:
        positions[2] = 5.0
    velocities = torch.randn(particles, dim, dtype=torch.float64, generator=generator)
    masses = 0.5 + torch.rand(particles, dtype=torch.float64, generator=generator)
    return *(values.to(dtype) for values in (positions, velocities, masses)), Box((0,) * dim, (1,) * dim, periodic)


def close(ours, reference, dtype):
    assert ours.dtype == dtype
    scale = float(reference.abs().max())
    torch.testing.assert_close(ours, reference, rtol=0, atol=(3e-6 if dtype == torch.float64 else 1e-5) * scale)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("periodic", [False, True])
@pytest.mark.parametrize("dim", [1, 2, 3])
@pytest.mark.parametrize("name", KERNELS)
def test_sums_are_those_of_the_operators(name, dim, periodic, dtype, generator):
    positions, velocities, masses, box = fluid(dim, dtype, generator, periodic)
    kernel = kernel_named(name)(0.45 / kernel_named(name).relative_support, dim)
    edges, sums = radius_graph(positions, 1.05 * kernel.support_radius, box), CompiledSums(kernel)
    densities = density(masses, edges, kernel)
    close(sums.density(masses, edges), densities, dtype)
    close(sums.density_rate(masses, velocities, edges), density_rate(masses, velocities, edges, kernel), dtype)
    reference = density_gradient(masses, densities, edges, kernel)
    close(sums.density_gradient(masses, densities, edges), reference, dtype)
    reference = velocity_gradient(masses / densities, velocities, edges, kernel)
    close(sums.velocity_gradient(masses / densities, velocities, edges), reference, dtype)


def test_sums_are_those_over_all_pairs(generator):
    """Against sums over a dense matrix of pairs, written out here."""
    positions, velocities, masses, box = fluid(2, torch.float64, generator)
    kernel = CubicSpline(0.15, 2)
    r = box.displacement(positions[:, None], positions[None])
    distances = r.norm(dim=2)
    slope = torch.where(distances > 0, kernel.derivative(distances) / distances.clamp_min(1e-30), 0.0)
    densities = (masses * kernel.value(distances)).sum(dim=1)
    rates = (masses * ((velocities[:, None] - velocities[None]) * r).sum(dim=2) * slope).sum(dim=1)
    gradient = ((masses * (densities[None] - densities[:, None]) * slope)[..., None] * r).sum(dim=1) / densities[
        :, None
    ]
    edges, sums = radius_graph(positions, kernel.support_radius, box), CompiledSums(kernel)
    close(sums.density(masses, edges), densities, torch.float64)
    close(sums.density_rate(masses, velocities, edges), rates, torch.float64)
    close(sums.density_gradient(masses, densities, edges), gradient, torch.float64)


def test_a_particle_that_is_listed_as_its_own_neighbour_counts_once(generator):
    positions, _, masses, box = fluid(2, torch.float64, generator)
    kernel = CubicSpline(0.15, 2)
    edges = radius_graph(positions, kernel.support_radius, box, include_self=True)
    close(CompiledSums(kernel).density(masses, edges), density(masses, edges, kernel), torch.float64)


def test_densities_at_some_particles_alone_are_those_of_all(generator):
    positions, _, masses, box = fluid(2, torch.float64, generator)
    sums = CompiledSums(CubicSpline(0.15, 2))
    everywhere = sums.density(masses, radius_graph(positions, 0.3, box))
    there = sums.density(masses, radius_graph(positions, 0.3, box, queries=positions[20:30]))
    torch.testing.assert_close(there, everywhere[20:30])


def test_threads_share_the_rows_and_change_nothing(generator):
    positions = torch.rand(4000, 3, generator=generator)
    velocities, masses = torch.randn(4000, 3, generator=generator), torch.ones(4000)
    kernel = CubicSpline(0.1, 3)
    edges, sums = radius_graph(positions, kernel.support_radius), CompiledSums(kernel)
    before = torch.get_num_threads()
    found = []
    for threads in (1, 2):
        torch.set_num_threads(threads)
        found.append(sums.density_rate(masses, velocities, edges))
    torch.set_num_threads(before)
    assert len(edges) > 100_000
    assert torch.equal(*found)


def test_no_particles_and_no_pairs():
    sums, kernel = CompiledSums(CubicSpline(0.1, 2)), CubicSpline(0.1, 2)
    edges = radius_graph(torch.zeros(0, 2), kernel.support_radius)
    assert sums.density_rate(torch.zeros(0), torch.zeros(0, 2), edges).shape == (0,)
    edges = radius_graph(torch.tensor([[0.0, 0.0], [1.0, 0.0]]), kernel.support_radius)
    alone = sums.density(torch.ones(2), edges)
    torch.testing.assert_close(alone, kernel.value(torch.zeros(2)))


def test_edges_that_do_not_fit_are_refused(generator):
    positions, velocities, masses, box = fluid(2, torch.float64, generator)
    sums = CompiledSums(CubicSpline(0.15, 2))
    edges = radius_graph(positions, 0.3, box)
    with pytest.raises(ShapeError, match="masses"):
        sums.density(masses[:-1], edges)
    with pytest.raises(ConfigError, match="reach as far"):
        sums.density_rate(masses, velocities, radius_graph(positions, 0.2, box))
    with pytest.raises(ConfigError, match="one set"):
        sums.density_gradient(masses, masses, radius_graph(positions, 0.3, box, queries=positions))
