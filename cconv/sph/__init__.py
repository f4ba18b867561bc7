"""Smoothed particle hydrodynamics: smoothing kernels, the sums that networks learn, a solver, and a relaxation."""

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
from cconv.sph.operators import density, density_gradient, density_rate, interpolate, velocity_gradient
from cconv.sph.relaxation import relax
from cconv.sph.solver import EquationOfState, ParticleState, Scheme, WeaklyCompressibleSPH

__all__ = [
    "KERNELS",
    "CubicSpline",
    "EquationOfState",
    "Gaussian",
    "ParticleState",
    "Poly6",
    "QuinticSpline",
    "Scheme",
    "WendlandC2",
    "WendlandC4",
    "WeaklyCompressibleSPH",
    "density",
    "density_gradient",
    "density_rate",
    "interpolate",
    "kernel_named",
    "relax",
    "velocity_gradient",
]
