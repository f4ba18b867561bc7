import math

import pytest
import torch
from oracles.brute_force_neighbors import brute_force_pairs

from cconv.domain import Box
from cconv.errors import ConfigError, ShapeError
from cconv.neighbors import radius_graph
from cconv.sph import (
    KERNELS,
    CubicSpline,
    WendlandC2,
    density,
    density_gradient,
    density_rate,
    interpolate,
    kernel_named,
    velocity_gradient,
)

SUPPORT = 0.45
DEFORMATION = torch.tensor([[1.0, 2.0, -0.5], [0.3, -2.5, 0.7], [0.1, 0.4, 3.5]], dtype=torch.float64)
SLOPE = torch.tensor([0.3, -0.2, 0.1], dtype=torch.float64)
# The truncated Gaussian's D2 and D3 of a linear field fall short by this much (its docstring), by dimension.
GAUSSIAN_SHORTFALL = {1: 0.0005, 2: 0.0012, 3: 0.0026}
# Dimension, particle spacings in a support radius, relative error allowed: coarse, then fine.
RESOLUTIONS = [(1, 4, 6e-3), (1, 8, 1e-3), (2, 4, 6e-3), (2, 8, 1e-3), (3, 4, 6e-3)]

over_all_kernels = pytest.mark.parametrize("name", KERNELS)
over_dims = pytest.mark.parametrize("dim", [1, 2, 3])
over_resolutions = pytest.mark.parametrize(("dim", "per_support", "tolerance"), RESOLUTIONS)


def make(name, dim, support=SUPPORT):
    return kernel_named(name)(support / kernel_named(name).relative_support, dim)


def unit_box(dim):
    return Box((0,) * dim, (1,) * dim, True)


def random_fluid(dim, generator, particles=25):
    """Positions in the unit box, velocities, masses."""
    positions = torch.rand(particles, dim, dtype=torch.float64, generator=generator)
    velocities = torch.randn(particles, dim, dtype=torch.float64, generator=generator)
    masses = 0.5 + torch.rand(particles, dtype=torch.float64, generator=generator)
    return positions, velocities, masses


def fields(positions, velocities, masses, kernel, box=None, **options):
    """D1, D2 and D3, the last with the densities of the first."""
    edges = radius_graph(positions, kernel.support_radius, box, **options)
    densities = density(masses, edges, kernel)
    rates = density_rate(masses, velocities, edges, kernel)
    return densities, rates, density_gradient(masses, densities, edges, kernel)


def filled_ball(dim, per_support):
    """Lattice in the ball of radius 1 around the origin, and the index of the particle there."""
    axis = torch.arange(-per_support, per_support + 1, dtype=torch.float64) / per_support
    positions = torch.cartesian_prod(*[axis] * dim).reshape(-1, dim)
    positions = positions[positions.norm(dim=1) <= 1 + 1e-9]
    return positions, int(positions.norm(dim=1).argmin())


def kernel_gradient_by_autograd(kernel, displacement):
    displacement = torch.tensor(displacement, dtype=torch.float64, requires_grad=True)
    return torch.autograd.grad(kernel.value(displacement.norm()), displacement)[0]


@over_all_kernels
@over_dims
def test_operators_equal_loops_over_all_pairs(name, dim, generator):
    kernel = make(name, dim)
    positions, velocities, masses = random_fluid(dim, generator)
    densities = 1 + torch.rand(len(masses), dtype=torch.float64, generator=generator)
    pairs = brute_force_pairs(positions, kernel.support_radius, [1.0] * dim)
    summed = masses * kernel.value(torch.zeros_like(masses))
    rates, gradients = torch.zeros_like(masses), torch.zeros_like(positions)
    for (i, j), displacement in pairs.items():
        slope = kernel_gradient_by_autograd(kernel, displacement)
        summed[i] += masses[j] * kernel.value(torch.tensor(math.hypot(*displacement), dtype=torch.float64))
        rates[i] += masses[j] * (velocities[i] - velocities[j]) @ slope
        gradients[i] += masses[j] * (densities[j] - densities[i]) * slope / densities[i]
    edges = radius_graph(positions, kernel.support_radius, unit_box(dim))
    torch.testing.assert_close(density(masses, edges, kernel), summed)
    torch.testing.assert_close(density_rate(masses, velocities, edges, kernel), rates)
    torch.testing.assert_close(density_gradient(masses, densities, edges, kernel), gradients)


@over_all_kernels
@over_resolutions
def test_density_of_a_lattice_is_its_rest_density(name, dim, per_support, tolerance):
    kernel = make(name, dim, 1.0)
    positions, centre = filled_ball(dim, per_support)
    rest_density = 1000.0
    masses = torch.full((len(positions),), rest_density / per_support**dim, dtype=torch.float64)
    densities = density(masses, radius_graph(positions, kernel.support_radius), kernel)
    assert float(densities[centre]) == pytest.approx(rest_density, rel=tolerance)


@over_all_kernels
@over_resolutions
def test_density_rate_of_a_linear_velocity_is_minus_density_times_divergence(name, dim, per_support, tolerance):
    kernel = make(name, dim, 1.0)
    positions, centre = filled_ball(dim, per_support)
    masses = torch.full((len(positions),), 2 / per_support**dim, dtype=torch.float64)
    deformation = DEFORMATION[:dim, :dim]
    rates = density_rate(masses, positions @ deformation.T + 3, radius_graph(positions, kernel.support_radius), kernel)
    if name == "gaussian":
        tolerance += GAUSSIAN_SHORTFALL[dim]
    assert float(rates[centre]) == pytest.approx(-2 * float(deformation.trace()), rel=tolerance)


@over_all_kernels
@over_resolutions
def test_density_gradient_of_a_linear_density_is_its_slope_and_the_printed_form_its_negative(
    name, dim, per_support, tolerance
):
    kernel = make(name, dim, 1.0)
    positions, centre = filled_ball(dim, per_support)
    densities = 2 + positions @ SLOPE[:dim]
    masses = densities / per_support**dim
    edges = radius_graph(positions, kernel.support_radius)
    if name == "gaussian":
        tolerance += GAUSSIAN_SHORTFALL[dim]
    ours = density_gradient(masses, densities, edges, kernel)[centre]
    printed = torch.zeros(dim, dtype=torch.float64)
    for (i, j), displacement in brute_force_pairs(positions, 1.0, queries=positions[[centre]]).items():
        assert i == 0
        if j != centre:
            slope = kernel_gradient_by_autograd(kernel, displacement)
            printed += masses[j] * (densities[centre] - densities[j]) * slope / densities[centre]
    scale = tolerance * float(SLOPE[:dim].norm())
    torch.testing.assert_close(ours, SLOPE[:dim], atol=scale, rtol=0)
    torch.testing.assert_close(printed, -SLOPE[:dim], atol=scale, rtol=0)
    torch.testing.assert_close(ours, -printed)


@over_all_kernels
def test_rate_and_gradient_of_smooth_fields_converge_at_second_order(name):
    """Eight particles in a support, so that the error of the smoothing, of order h^2, stands out."""

    def errors(particles):
        kernel = make(name, 1, 8 / particles)
        positions = torch.arange(particles, dtype=torch.float64)[:, None] / particles
        masses = torch.full((particles,), 1 / particles, dtype=torch.float64)
        angles = 2 * math.pi * positions[:, 0]
        edges = radius_graph(positions, kernel.support_radius, unit_box(1))
        rates = density_rate(masses, torch.sin(angles)[:, None], edges, kernel)
        # With rho = 1 + small, m = dx rho and 1 / rho differ from dx and 1 by the small square only.
        small = 1e-6
        densities = 1 + small * torch.sin(angles)
        gradients = density_gradient(masses, densities, edges, kernel)[:, 0] / small
        exact = 2 * math.pi * torch.cos(angles)
        return (rates + exact).abs().max(), (gradients - exact).abs().max()

    for coarse, fine in zip(errors(32), errors(64), strict=True):
        assert math.log2(coarse / fine) == pytest.approx(2, abs=0.25)


@over_all_kernels
@over_dims
def test_density_rate_is_the_time_derivative_of_density_along_the_motion(name, dim, generator):
    """D2 = d/dt D1(x + t v), exactly, for any masses."""
    kernel, box = make(name, dim), unit_box(dim)
    positions, velocities, masses = random_fluid(dim, generator)

    def density_at(positions):
        return density(masses, radius_graph(positions, kernel.support_radius, box), kernel)

    derivative = torch.autograd.functional.jvp(density_at, positions, velocities)[1]
    rates = density_rate(masses, velocities, radius_graph(positions, kernel.support_radius, box), kernel)
    torch.testing.assert_close(rates, derivative)
    assert rates.abs().max() > 0.1


@pytest.mark.parametrize("name", sorted(KERNELS.keys() - {"gaussian"}))
@over_dims
def test_density_rate_is_the_rate_that_moving_particles_show(name, dim, generator):
    """Pairs that enter and leave the support included, but for the Gaussian, whose cut makes them jump."""
    kernel, box = make(name, dim), unit_box(dim)
    positions, velocities, masses = random_fluid(dim, generator)
    time = 1e-5

    def density_after(time):
        edges = radius_graph(positions + time * velocities, kernel.support_radius, box)
        return density(masses, edges, kernel)

    seen = (density_after(time) - density_after(-time)) / (2 * time)
    rates = density_rate(masses, velocities, radius_graph(positions, kernel.support_radius, box), kernel)
    torch.testing.assert_close(rates, seen, atol=1e-6 * float(rates.abs().max()), rtol=0)


@over_all_kernels
@over_dims
def test_both_particles_of_a_pair_see_the_same_mass_weighted_rate_and_gradient(name, dim, generator):
    """m_i (Dρ_i/Dt)_j = m_j (Dρ_j/Dt)_i: both factors change sign. The same holds for m ρ ∇ρ."""
    kernel = make(name, dim)
    velocities = torch.randn(2, dim, dtype=torch.float64, generator=generator)
    masses, densities = torch.tensor([[0.3, 1.7], [2.0, 5.0]], dtype=torch.float64)
    positions = torch.full((2, dim), 0.1, dtype=torch.float64)
    positions[1] += 0.6 * SUPPORT / math.sqrt(dim)
    edges = radius_graph(positions, kernel.support_radius)
    rates = masses * density_rate(masses, velocities, edges, kernel)
    gradients = (masses * densities)[:, None] * density_gradient(masses, densities, edges, kernel)
    assert rates[0].abs() > 1e-3
    torch.testing.assert_close(rates[0], rates[1])
    torch.testing.assert_close(gradients[0], gradients[1])


@over_all_kernels
@over_dims
def test_mass_weighted_rates_sum_to_the_change_of_the_pair_sum(name, dim, generator):
    """Σ m_i Dρ_i/Dt is not zero: it is d/dt of Σ_i m_i ρ_i, twice that of the sum of m_i m_j W over pairs."""
    kernel, box = make(name, dim), unit_box(dim)
    positions, velocities, masses = random_fluid(dim, generator)
    positions.requires_grad_()
    edges = radius_graph(positions, kernel.support_radius, box)
    once = edges.receivers < edges.senders
    products = masses[edges.receivers[once]] * masses[edges.senders[once]]
    pair_sum = (products * kernel.value(edges.distances[once])).sum()
    (slope,) = torch.autograd.grad(pair_sum, positions)
    total = (masses * density_rate(masses, velocities, edges, kernel)).sum()
    torch.testing.assert_close(total.detach(), 2 * (slope * velocities).sum())


@over_all_kernels
@over_dims
def test_converging_flow_raises_every_density(name, dim, generator):
    kernel = make(name, dim)
    positions, _, masses = random_fluid(dim, generator)
    edges = radius_graph(positions, kernel.support_radius)
    rates = density_rate(masses, -positions, edges, kernel)
    has_neighbours = edges.row_splits.diff() > 0
    assert has_neighbours.any()
    assert (rates[has_neighbours] > 0).all()


@over_all_kernels
@over_dims
def test_translation_changes_no_density(name, dim, generator):
    kernel = make(name, dim)
    positions, _, masses = random_fluid(dim, generator)
    wind = torch.full_like(positions, 3.7)
    rates = density_rate(masses, wind, radius_graph(positions, kernel.support_radius, unit_box(dim)), kernel)
    assert torch.equal(rates, torch.zeros_like(masses))


@over_all_kernels
@pytest.mark.parametrize("dim", [2, 3])
def test_rigid_rotation_changes_no_density(name, dim, generator):
    """v_i - v_j stands upright on x_i - x_j."""
    kernel = make(name, dim)
    positions, _, masses = random_fluid(dim, generator)
    spin = torch.randn(dim, dim, dtype=torch.float64, generator=generator)
    edges = radius_graph(positions, kernel.support_radius)
    rates = density_rate(masses, positions @ (spin - spin.T), edges, kernel)
    scale = density_rate(masses, positions, edges, kernel).abs().max()
    assert float(rates.abs().max() / scale) < 1e-13


@over_all_kernels
@over_dims
def test_the_trace_of_the_velocity_gradient_is_the_density_rate(name, dim, generator):
    """By mass instead of volume, the divergence is the rate at which density falls, to rounding."""
    kernel = make(name, dim)
    positions, velocities, masses = random_fluid(dim, generator)
    edges = radius_graph(positions, kernel.support_radius)
    gradients = velocity_gradient(masses, velocities, edges, kernel)
    rates = density_rate(masses, velocities, edges, kernel)
    torch.testing.assert_close(-torch.einsum("nii->n", gradients), rates, atol=1e-10, rtol=1e-10)


@over_all_kernels
@over_resolutions
def test_velocity_gradient_of_a_linear_velocity_is_its_deformation(name, dim, per_support, tolerance):
    kernel = make(name, dim, 1.0)
    positions, centre = filled_ball(dim, per_support)
    volumes = torch.full((len(positions),), 1 / per_support**dim, dtype=torch.float64)
    deformation = DEFORMATION[:dim, :dim]
    edges = radius_graph(positions, kernel.support_radius)
    gradients = velocity_gradient(volumes, positions @ deformation.T + 3, edges, kernel)
    if name == "gaussian":
        tolerance += GAUSSIAN_SHORTFALL[dim]
    torch.testing.assert_close(gradients[centre], deformation, atol=tolerance * float(deformation.abs().max()), rtol=0)


@over_all_kernels
@over_dims
def test_uniform_density_has_no_gradient(name, dim, generator):
    kernel = make(name, dim)
    positions, _, masses = random_fluid(dim, generator)
    edges = radius_graph(positions, kernel.support_radius)
    gradients = density_gradient(masses, torch.full_like(masses, 7.0), edges, kernel)
    assert torch.equal(gradients, torch.zeros_like(positions))


@over_all_kernels
@over_dims
def test_fields_do_not_see_a_shift_across_the_seam(name, dim, generator):
    kernel, box = make(name, dim), unit_box(dim)
    positions, velocities, masses = random_fluid(dim, generator)
    shift = torch.rand(dim, dtype=torch.float64, generator=generator)
    expected = fields(positions, velocities, masses, kernel, box)
    shifted = fields(box.wrap(positions + shift), velocities, masses, kernel, box)
    torch.testing.assert_close(shifted, expected, atol=1e-10, rtol=1e-10)


@over_all_kernels
@over_dims
def test_fields_do_not_see_where_they_are_nor_a_common_velocity(name, dim, generator):
    kernel = make(name, dim)
    positions, velocities, masses = random_fluid(dim, generator)
    moved = fields(positions + 5, velocities - 3, masses, kernel)
    torch.testing.assert_close(moved, fields(positions, velocities, masses, kernel), atol=1e-10, rtol=1e-10)


@over_all_kernels
@over_dims
@pytest.mark.parametrize("sign", [1, -1], ids=["rotation", "reflection"])
def test_fields_turn_with_the_particles(name, dim, sign, generator):
    kernel = make(name, dim)
    positions, velocities, masses = random_fluid(dim, generator)
    turn = torch.linalg.qr(torch.randn(dim, dim, dtype=torch.float64, generator=generator)).Q
    turn[:, 0] *= sign * torch.linalg.det(turn).sign()
    densities, rates, gradients = fields(positions, velocities, masses, kernel)
    turned = fields(positions @ turn, velocities @ turn, masses, kernel)
    torch.testing.assert_close(turned, (densities, rates, gradients @ turn), atol=1e-10, rtol=1e-10)


@over_all_kernels
@over_dims
def test_fields_follow_the_order_of_the_particles(name, dim, generator):
    kernel, box = make(name, dim), unit_box(dim)
    positions, velocities, masses = random_fluid(dim, generator)
    order = torch.randperm(len(masses), generator=generator)
    expected = tuple(field[order] for field in fields(positions, velocities, masses, kernel, box))
    permuted = fields(positions[order], velocities[order], masses[order], kernel, box)
    torch.testing.assert_close(permuted, expected)


@over_all_kernels
def test_fields_grow_with_mass_and_speed_as_their_units_say(name, generator):
    kernel = make(name, 2)
    positions, velocities, masses = random_fluid(2, generator)
    densities, rates, gradients = fields(positions, velocities, masses, kernel)
    scaled = fields(positions, 3 * velocities, 2 * masses, kernel)
    torch.testing.assert_close(scaled, (2 * densities, 6 * rates, 2 * gradients))


@over_all_kernels
@pytest.mark.parametrize("options", [{"include_self": True}, {}])
@pytest.mark.parametrize("reach", [1.0, 1.1])
def test_fields_do_not_depend_on_listed_selves_or_pairs_beyond_the_support(name, options, reach, generator):
    kernel, box = make(name, 2), unit_box(2)
    positions, velocities, masses = random_fluid(2, generator)
    expected = fields(positions, velocities, masses, kernel, box)
    edges = radius_graph(positions, reach * kernel.support_radius, box, **options)
    torch.testing.assert_close(density(masses, edges, kernel), expected[0])
    torch.testing.assert_close(density_rate(masses, velocities, edges, kernel), expected[1])
    torch.testing.assert_close(density_gradient(masses, expected[0], edges, kernel), expected[2])


@over_all_kernels
@over_dims
@pytest.mark.parametrize("include_self", [False, True])
def test_lone_particles_have_their_own_density_and_no_change(name, dim, include_self, generator):
    kernel = make(name, dim)
    positions = torch.zeros(2, dim, dtype=torch.float64)
    positions[1] = 10
    masses = torch.tensor([1.5, 0.2], dtype=torch.float64)
    velocities = torch.randn(2, dim, dtype=torch.float64, generator=generator)
    densities, rates, gradients = fields(positions, velocities, masses, kernel, include_self=include_self)
    torch.testing.assert_close(densities, masses * kernel.value(torch.zeros(2, dtype=torch.float64)))
    assert torch.equal(rates, torch.zeros_like(rates))
    assert torch.equal(gradients, torch.zeros_like(gradients))


def test_no_particles_have_no_fields():
    nothing = torch.zeros(0, 2, dtype=torch.float64)
    densities, rates, gradients = fields(nothing, nothing, nothing[:, 0], make("cubic_spline", 2))
    assert densities.shape == rates.shape == (0,)
    assert gradients.shape == (0, 2)


@over_all_kernels
def test_density_at_queries_has_no_contribution_of_the_queries(name, generator):
    kernel, box = make(name, 2), unit_box(2)
    positions, _, masses = random_fluid(2, generator)
    at_particles = density(masses, radius_graph(positions, kernel.support_radius, box), kernel)
    queries = torch.cat([positions[:5], torch.rand(4, 2, dtype=torch.float64, generator=generator)])
    edges = radius_graph(positions, kernel.support_radius, box, queries)
    at_queries = density(masses, edges, kernel)
    assert at_queries.shape == (9,)
    torch.testing.assert_close(at_queries[:5], at_particles[:5])
    far = radius_graph(positions, kernel.support_radius, queries=torch.full((1, 2), 9.0, dtype=torch.float64))
    assert density(masses, far, kernel).tolist() == [0.0]


@over_all_kernels
@over_dims
def test_fields_are_differentiable(name, dim, generator):
    kernel, box = make(name, dim), unit_box(dim)
    fluid = tuple(tensor.requires_grad_() for tensor in random_fluid(dim, generator, particles=5))
    assert len(radius_graph(fluid[0], kernel.support_radius, box)) > 2
    assert torch.autograd.gradcheck(lambda *fluid: fields(*fluid, kernel, box), fluid)


@over_all_kernels
def test_fields_are_twice_differentiable(name, generator):
    kernel, box = make(name, 2), unit_box(2)
    fluid = tuple(tensor.requires_grad_() for tensor in random_fluid(2, generator, particles=5))
    assert torch.autograd.gradgradcheck(lambda *fluid: fields(*fluid, kernel, box), fluid)


@over_all_kernels
def test_density_gradient_is_differentiable_in_the_densities(name, generator):
    kernel = make(name, 2)
    positions, _, masses = random_fluid(2, generator, particles=5)
    densities = (1 + masses).requires_grad_()
    edges = radius_graph(positions, kernel.support_radius, unit_box(2))
    assert torch.autograd.gradcheck(lambda rho: density_gradient(masses, rho, edges, kernel), densities)


@over_all_kernels
def test_particles_at_the_same_place_do_not_push_each_other(name, generator):
    """Neither NaN forwards nor backwards, and the same fields as without the coincidence's direction."""
    kernel = make(name, 2)
    positions = torch.full((3, 2), 0.3, dtype=torch.float64, requires_grad=True)
    velocities = torch.randn(3, 2, dtype=torch.float64, generator=generator)
    masses = torch.tensor([1.0, 2.0, 3.0], dtype=torch.float64)
    densities, rates, gradients = fields(positions, velocities, masses, kernel, include_self=True)
    torch.testing.assert_close(densities, 6 * kernel.value(torch.zeros(3, dtype=torch.float64)))
    assert rates.tolist() == [0.0] * 3
    assert gradients.tolist() == [[0.0] * 2] * 3
    (slope,) = torch.autograd.grad(densities.sum() + rates.sum() + gradients.sum(), positions)
    assert torch.isfinite(slope).all()


@over_all_kernels
@over_dims
def test_single_precision_is_kept_and_close_to_double(name, dim, generator):
    kernel, box = make(name, dim), unit_box(dim)
    fluid = random_fluid(dim, generator)
    single = fields(*(tensor.float() for tensor in fluid), kernel, box)
    for field, expected in zip(single, fields(*fluid, kernel, box), strict=True):
        assert field.dtype == torch.float32
        error = (field.double() - expected).abs().max() / expected.abs().max()
        assert float(error) < (1e-3 if name == "gaussian" else 1e-5)


def test_masses_must_fit_the_edges():
    positions, kernel = torch.zeros(4, 2), CubicSpline(0.1, 2)
    edges = radius_graph(positions, 0.2)
    with pytest.raises(ShapeError, match=r"`masses` must have shape \(4\), got \(4, 1\)"):
        density(torch.ones(4, 1), edges, kernel)
    with pytest.raises(ShapeError, match="`masses`"):
        density_rate(torch.ones(3), positions, edges, kernel)
    with pytest.raises(ShapeError, match="`masses`"):
        density_gradient(torch.ones(5), torch.ones(4), edges, kernel)


def test_velocities_and_densities_must_fit_the_edges():
    edges, masses, kernel = radius_graph(torch.zeros(4, 2), 0.2), torch.ones(4), CubicSpline(0.1, 2)
    for shape in [(4, 3), (5, 2), (4,), (1, 2)]:
        with pytest.raises(ShapeError, match=r"`velocities` must have shape \(4, 2\)"):
            density_rate(masses, torch.ones(shape), edges, kernel)
    for shape in [(4, 1), (5,), (1,), ()]:
        with pytest.raises(ShapeError, match=r"`densities` must have shape \(4\)"):
            density_gradient(masses, torch.ones(shape), edges, kernel)


def every_operator(edges, kernel, particles=4, dim=2):
    masses, velocities = torch.ones(particles), torch.ones(particles, dim)
    yield lambda: density(masses, edges, kernel)
    yield lambda: density_rate(masses, velocities, edges, kernel)
    yield lambda: density_gradient(masses, masses, edges, kernel)
    yield lambda: velocity_gradient(masses, velocities, edges, kernel)


def test_edges_must_reach_as_far_as_the_kernel():
    positions, kernel = torch.zeros(4, 2), WendlandC2(0.1, 2)
    for operator in every_operator(radius_graph(positions, 0.19), kernel):
        with pytest.raises(ConfigError, match=r"`edges` must reach.*\(0.2\), got a cutoff of 0.19"):
            operator()


def test_rounding_of_the_cutoff_is_forgiven():
    kernel = WendlandC2(0.1, 2)
    edges = radius_graph(torch.zeros(4, 2), math.nextafter(kernel.support_radius, 0))
    assert [operator().isfinite().all().item() for operator in every_operator(edges, kernel)] == [True] * 4


def test_kernel_must_have_the_dimension_of_the_edges():
    for operator in every_operator(radius_graph(torch.zeros(4, 2), 0.2), WendlandC2(0.1, 3)):
        with pytest.raises(ConfigError, match=r"`kernel` must have the dimension of `edges` \(2\), got 3"):
            operator()


def test_rate_and_gradient_need_edges_within_one_set():
    positions = torch.zeros(4, 2)
    _, *operators = every_operator(radius_graph(positions, 0.2, queries=positions), WendlandC2(0.1, 2))
    for operator in operators:
        with pytest.raises(ConfigError, match="`edges` must join the particles of one set"):
            operator()


@over_all_kernels
@over_dims
def test_interpolation_reproduces_constants_and_weighs_by_volume_and_kernel(name, dim, generator):
    kernel, (positions, velocities, volumes) = make(name, dim), random_fluid(dim, generator)
    points = torch.rand(7, dim, dtype=torch.float64, generator=generator)
    edges = radius_graph(positions, kernel.support_radius, queries=points)
    alone = edges.row_splits.diff() == 0
    constant = interpolate(torch.full((25, 1), 3.7, dtype=torch.float64), volumes, edges, kernel)
    torch.testing.assert_close(constant[~alone], torch.full_like(constant[~alone], 3.7))
    weights = (
        volumes
        * kernel.value(torch.cdist(points, positions))
        * (torch.cdist(points, positions) <= kernel.support_radius)
    )
    expected = weights @ velocities / weights.sum(dim=1, keepdim=True)
    found = interpolate(velocities, volumes, edges, kernel)
    torch.testing.assert_close(found, expected, equal_nan=True)
    assert found.isnan().all(dim=1).equal(alone)


def test_interpolation_refuses_values_of_other_particles(generator):
    kernel, (positions, velocities, volumes) = make("cubic_spline", 2), random_fluid(2, generator)
    edges = radius_graph(positions, kernel.support_radius)
    with pytest.raises(ShapeError, match="`values` must have shape"):
        interpolate(velocities[1:], volumes, edges, kernel)
