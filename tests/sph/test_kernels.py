import math

import numpy as np
import pytest
import torch
from oracles.quadrature import ball_rule
from scipy.interpolate import BSpline

from cconv.errors import ConfigError
from cconv.sph import KERNELS, CubicSpline, Gaussian, QuinticSpline, kernel_named

SMOOTHING_LENGTH = 0.7
# Where the pieces of a kernel meet, in units of h; the last is its support.
KNOTS = {
    "cubic_spline": (1, 2),
    "quintic_spline": (1, 2, 3),
    "wendland_c2": (2,),
    "wendland_c4": (2,),
    "poly6": (1,),
    "gaussian": (3,),
}
# W(qh) / W(0), worked out by hand from the published polynomials: (q, in 1D, in 2D and 3D).
SHAPES = {
    "cubic_spline": (1.0, 1 / 4, 1 / 4),
    "quintic_spline": (1.0, 26 / 66, 26 / 66),
    "wendland_c2": (1.0, 5 / 16, 3 / 16),
    "wendland_c4": (1.0, 11 / 64, 83 / 768),
    "poly6": (0.5, 27 / 64, 27 / 64),
    "gaussian": (1.0, math.exp(-1), math.exp(-1)),
}

over_all_kernels = pytest.mark.parametrize("name", KERNELS)
over_dims = pytest.mark.parametrize("dim", [1, 2, 3])


def make(name, dim, smoothing_length=SMOOTHING_LENGTH):
    return kernel_named(name)(smoothing_length, dim)


def rule(name, kernel):
    points, weights = ball_rule([knot * kernel.smoothing_length for knot in KNOTS[name]], kernel.dim)
    return torch.from_numpy(points), torch.from_numpy(weights)


def radii(kernel, count=2001, reach=1.0):
    return torch.linspace(0, reach * kernel.support_radius, count, dtype=torch.float64)


def peak(kernel):
    return float(kernel.value(torch.zeros((), dtype=torch.float64)))


@over_all_kernels
@over_dims
def test_kernel_integrates_to_one(name, dim):
    kernel = make(name, dim)
    points, weights = rule(name, kernel)
    total = (weights * kernel.value(points.norm(dim=1))).sum()
    assert float(total) == pytest.approx(1, abs=1e-12)


@over_all_kernels
@over_dims
def test_slope_takes_minus_dim_as_its_first_moment(name, dim):
    """∫ r W' = -D ∫ W by parts, plus what a jump at the support leaves on the sphere."""
    kernel = make(name, dim)
    points, weights = rule(name, kernel)
    r = points.norm(dim=1)
    moment = float((weights * r * kernel.derivative(r)).sum())
    sphere = {1: 2, 2: 2 * math.pi, 3: 4 * math.pi}[dim] * kernel.support_radius**dim
    jump = peak(kernel) * math.exp(-9) if name == "gaussian" else 0
    assert moment == pytest.approx(-dim + sphere * jump, abs=1e-12)


@over_all_kernels
@over_dims
def test_kernel_has_compact_support(name, dim):
    kernel = make(name, dim)
    assert kernel.support_radius == pytest.approx(KNOTS[name][-1] * SMOOTHING_LENGTH)
    outside = kernel.support_radius * torch.tensor([1, 1.001, 1.5, 10, 1e6], dtype=torch.float64)
    assert torch.equal(kernel.value(outside), torch.zeros_like(outside))
    assert torch.equal(kernel.derivative(outside), torch.zeros_like(outside))


@over_all_kernels
@over_dims
def test_kernel_is_positive_inside_its_support_and_decays(name, dim):
    kernel = make(name, dim)
    r = radii(kernel)[1:-1]
    assert (kernel.value(r) > 0).all()
    assert (kernel.derivative(r) < 0).all()
    assert (kernel.value(radii(kernel, reach=1.5)).diff() <= 0).all()


@over_all_kernels
@over_dims
def test_kernel_and_slope_are_continuous(name, dim):
    """No step between close radii beyond what slope and curvature allow, knots and support included."""
    kernel = make(name, dim)
    h = SMOOTHING_LENGTH
    ends = torch.tensor(KNOTS[name], dtype=torch.float64) * h
    step = 1e-6 * h
    # The cut of the Gaussian leaves the jump that its docstring states.
    cut = math.exp(-9) if name == "gaussian" else 0
    jumps = torch.tensor([0.0] * (len(ends) - 1) + [cut], dtype=torch.float64) * peak(kernel)
    below, above = ends - step, ends + step
    value_steps = kernel.value(below) - kernel.value(above)
    slope_steps = kernel.derivative(below) - kernel.derivative(above)
    torch.testing.assert_close(value_steps, jumps, atol=1e-5 * peak(kernel), rtol=0)
    torch.testing.assert_close(slope_steps, -6 * jumps / h, atol=1e-4 * peak(kernel) / h, rtol=0)
    inside = radii(kernel)[:-1]
    assert kernel.value(inside).diff().abs().max() < 2 * peak(kernel) / h * float(inside[1])
    assert kernel.derivative(inside).diff().abs().max() < 10 * peak(kernel) / h**2 * float(inside[1])


@over_all_kernels
@over_dims
def test_slope_vanishes_at_the_centre(name, dim):
    kernel = make(name, dim)
    assert float(kernel.derivative(torch.zeros((), dtype=torch.float64))) == pytest.approx(0, abs=1e-14)


@over_all_kernels
@over_dims
def test_kernel_depends_on_distance_only(name, dim, generator):
    kernel = make(name, dim)
    displacements = torch.randn(50, dim, dtype=torch.float64, generator=generator)
    rotation = torch.linalg.qr(torch.randn(dim, dim, dtype=torch.float64, generator=generator)).Q
    turned = kernel.value((displacements @ rotation).norm(dim=1))
    torch.testing.assert_close(turned, kernel.value(displacements.norm(dim=1)))
    torch.testing.assert_close(kernel.value((-displacements).norm(dim=1)), kernel.value(displacements.norm(dim=1)))


@over_all_kernels
@over_dims
def test_kernel_tends_to_dirac_at_second_order(name, dim):
    """Smoothing f around a point gives f + h^2 c ∆f + O(h^4), with 2 D c the second moment of the kernel."""
    direction = torch.tensor([1.0, -0.5, 0.7], dtype=torch.float64)[:dim]

    def smoothing_error(h):
        kernel = make(name, dim, h)
        points, weights = rule(name, kernel)
        field = torch.exp(points @ direction) + torch.sin(points[:, 0])
        return float((weights * kernel.value(points.norm(dim=1)) * field).sum()) - 1

    coarse, fine = smoothing_error(0.1), smoothing_error(0.05)
    assert 0 < fine < coarse < 0.02
    assert math.log2(coarse / fine) == pytest.approx(2, abs=0.02)


@over_all_kernels
@over_dims
def test_derivative_is_the_slope_of_value(name, dim, generator):
    kernel = make(name, dim)
    r = torch.rand(200, dtype=torch.float64, generator=generator) * 1.3 * kernel.support_radius
    r.requires_grad_()
    (slope,) = torch.autograd.grad(kernel.value(r).sum(), r)
    torch.testing.assert_close(kernel.derivative(r.detach()), slope, atol=1e-12, rtol=1e-10)


@over_all_kernels
@over_dims
def test_kernel_has_its_published_shape(name, dim):
    q, on_a_line, elsewhere = SHAPES[name]
    kernel = make(name, dim)
    value = float(kernel.value(torch.tensor(q * SMOOTHING_LENGTH, dtype=torch.float64)))
    assert value / peak(kernel) == pytest.approx(on_a_line if dim == 1 else elsewhere, rel=1e-12)


@pytest.mark.parametrize(("kernel_class", "knots"), [(CubicSpline, range(-2, 3)), (QuinticSpline, range(-3, 4))])
def test_splines_on_a_line_are_b_splines(kernel_class, knots):
    q = np.linspace(0, knots[-1], 100, endpoint=False)
    expected = BSpline.basis_element(list(knots), extrapolate=False)(q)
    np.testing.assert_allclose(kernel_class(1.0, 1).value(torch.from_numpy(q)).numpy(), expected, atol=1e-14)


def test_quintic_constant_in_space_is_not_the_often_printed_one():
    exact = peak(QuinticSpline(1.0, 3)) / 66
    assert exact == pytest.approx(1 / (120 * math.pi), rel=1e-14)
    assert 3 / (359 * math.pi) / exact == pytest.approx(1.0028, abs=5e-5)


@over_dims
def test_gaussian_jump_at_the_cut(dim):
    kernel = Gaussian(SMOOTHING_LENGTH, dim)
    edge = torch.tensor(kernel.support_radius * (1 - 1e-12), dtype=torch.float64)
    assert float(kernel.value(edge)) / peak(kernel) == pytest.approx(1.2e-4, rel=0.05)
    assert -float(kernel.derivative(edge)) * SMOOTHING_LENGTH / peak(kernel) == pytest.approx(7.4e-4, rel=0.01)


@pytest.mark.parametrize(("dim", "shortfall"), [(1, 0.0004), (2, 0.0011), (3, 0.0025)])
def test_gaussian_first_moment_misses_the_jump(dim, shortfall):
    kernel = Gaussian(SMOOTHING_LENGTH, dim)
    points, weights = rule("gaussian", kernel)
    r = points.norm(dim=1)
    assert 1 + float((weights * r * kernel.derivative(r)).sum()) / dim == pytest.approx(shortfall, abs=5e-5)


@over_all_kernels
@over_dims
def test_kernel_scales_with_its_smoothing_length(name, dim):
    r = torch.linspace(0, 4, 50, dtype=torch.float64)
    small, large = make(name, dim, 0.5), make(name, dim, 1.5)
    torch.testing.assert_close(small.value(r / 3), large.value(r) * 3**dim)
    torch.testing.assert_close(small.derivative(r / 3), large.derivative(r) * 3 ** (dim + 1))


@over_all_kernels
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_kernel_keeps_dtype_and_shape(name, dtype):
    r = torch.linspace(0, 2, 12, dtype=dtype).reshape(3, 4)
    kernel = make(name, 2)
    for result in (kernel.value(r), kernel.derivative(r)):
        assert result.dtype == dtype
        assert result.shape == (3, 4)
    torch.testing.assert_close(kernel.value(r).double(), kernel.value(r.double()), atol=1e-6, rtol=1e-5)


def test_kernels_are_values():
    assert CubicSpline(0.1, 2) == CubicSpline(0.1, 2)
    assert CubicSpline(0.1, 2) != CubicSpline(0.1, 3)
    assert CubicSpline(0.1, 2) != QuinticSpline(0.1, 2)
    with pytest.raises(AttributeError):
        CubicSpline(0.1, 2).dim = 3


@over_all_kernels
@pytest.mark.parametrize("smoothing_length", [0.0, -0.1, math.nan, math.inf])
def test_bad_smoothing_length_is_refused(name, smoothing_length):
    with pytest.raises(ConfigError, match="`smoothing_length` must be positive"):
        make(name, 2, smoothing_length)


@over_all_kernels
@pytest.mark.parametrize("dim", [0, 4, 2.5])
def test_bad_dimension_is_refused(name, dim):
    with pytest.raises(ConfigError, match="`dim` must be 1, 2 or 3"):
        make(name, dim)


def test_unknown_kernel_names_the_known_ones():
    with pytest.raises(ConfigError, match="cubic_spline, quintic_spline.*Did you mean 'quintic_spline'"):
        kernel_named("quintic_splin")
