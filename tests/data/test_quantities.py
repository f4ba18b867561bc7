from dataclasses import replace

import torch
from systems import periodic_frame, periodic_scene

from cconv.data.quantities import density_deviation, mean_neighbors, speed
from cconv.domain import Box
from cconv.neighbors import radius_graph
from cconv.sph.kernels import QuinticSpline
from cconv.sph.operators import density


def lattice(generator, particles_per_side=8):
    ticks = (torch.arange(particles_per_side, dtype=torch.float64) + 0.5) / particles_per_side
    return replace(periodic_frame(generator, particles_per_side), positions=torch.cartesian_prod(ticks, ticks))


def test_a_lattice_in_a_periodic_box_has_rest_density(generator):
    deviation = density_deviation(lattice(generator), periodic_scene())
    assert deviation.abs().max() < 1e-4


def test_deviation_does_not_depend_on_the_unit_of_mass(generator):
    frame, scene = periodic_frame(generator), periodic_scene()
    heavier = replace(frame, masses=1000 * frame.masses)
    torch.testing.assert_close(density_deviation(heavier, scene), density_deviation(frame, scene))


def test_density_is_below_rest_at_a_free_surface_only(generator):
    frame = lattice(generator, 16)
    deviation = density_deviation(frame, replace(periodic_scene(16), box=Box([0, 0], [1, 1])))
    inside = ((frame.positions > 3 / 16) & (frame.positions < 13 / 16)).all(dim=1)
    assert deviation[inside].abs().max() < 1e-4
    assert deviation[frame.positions[:, 1] > 15 / 16].max() < -0.2


def test_deviation_is_that_of_the_exact_sum_in_any_blocks(generator, monkeypatch):
    frame, scene = periodic_frame(generator), periodic_scene()
    kernel = QuinticSpline(scene.particle_spacing, 2)
    masses = frame.masses.double()
    exact = density(masses, radius_graph(frame.positions.double(), kernel.support_radius, scene.box), kernel)
    monkeypatch.setattr("cconv.data.quantities._BLOCK", 10)
    expected = exact * scene.particle_spacing**2 / masses - 1
    torch.testing.assert_close(density_deviation(frame, scene), expected, rtol=0, atol=3e-6)


def test_wall_particles_count(generator):
    frame, scene = periodic_frame(generator), periodic_scene()
    walls = replace(frame, particle_types=torch.arange(64) % 3)
    assert torch.equal(density_deviation(walls, scene), density_deviation(frame, scene))


def test_speed_is_the_length_of_the_velocity(generator):
    frame = replace(periodic_frame(generator), velocities=torch.tensor([[3.0, -4.0]]).expand(64, 2))
    assert torch.equal(speed(frame), torch.full((64,), 5.0))


def test_a_mean_number_of_neighbours_is_exact_for_few_particles_and_near_for_many(generator):
    few, many = (torch.rand(count, 2, generator=generator, dtype=torch.float64) for count in (900, 6000))
    for points, off in ((few, 1e-12), (many, 0.05)):
        exact = float((torch.cdist(points, points) <= 0.1).sum(dim=1).double().mean())
        assert abs(mean_neighbors(points, 0.1) / exact - 1) <= off
