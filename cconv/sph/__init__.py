"""Analytic smoothed particle hydrodynamics: smoothing kernels, and the sums that networks learn."""

from cconv.sph.kernels import (
    KERNELS,
    CubicSpline,
    Gaussian,
    Poly6,
    QuinticSpline,
    WendlandC2,
    WendlandC4,
    kernel_named,
)
from cconv.sph.operators import density, density_gradient, density_rate

__all__ = [
    "KERNELS",
    "CubicSpline",
    "Gaussian",
    "Poly6",
    "QuinticSpline",
    "WendlandC2",
    "WendlandC4",
    "density",
    "density_gradient",
    "density_rate",
    "kernel_named",
]
