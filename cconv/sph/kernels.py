r"""SPH smoothing kernels W(r, h) in one, two and three dimensions, normalised to integral 1.

Every kernel is :math:`W(r) = \sigma_D h^{-D} w(q)` with :math:`q = r/h`, and :math:`W = 0` from its support radius
:math:`\kappa h` on. A kernel gives its profile w and w', its constants :math:`\sigma_D` and :math:`\kappa`.
"""

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import ClassVar

import torch
from jaxtyping import Float
from torch import Tensor

from cconv.errors import ConfigError, check_choice


@dataclass(frozen=True)
class AbstractKernel(ABC):
    """A radial kernel.

    Args:
        smoothing_length: h, length.
        dim: Number of space dimensions D, 1 to 3.

    Raises:
        ConfigError: If h is not positive or D is not 1, 2 or 3.
    """

    smoothing_length: float
    dim: int
    relative_support: ClassVar[float]

    def __post_init__(self):
        if not (math.isfinite(self.smoothing_length) and self.smoothing_length > 0):
            raise ConfigError(f"`smoothing_length` must be positive, got {self.smoothing_length}.")
        if self.dim not in (1, 2, 3):
            raise ConfigError(f"`dim` must be 1, 2 or 3, got {self.dim}.")

    @property
    def support_radius(self) -> float:
        """Distance κh from which on W is 0."""
        return self.relative_support * self.smoothing_length

    def value(self, r: Float[Tensor, "*shape"]) -> Float[Tensor, "*shape"]:
        """W(r), 1/length^D, for distances r of any shape."""
        q = r / self.smoothing_length
        scale = self._sigma() / self.smoothing_length**self.dim
        return torch.where(r < self.support_radius, scale * self._profile(q), 0.0)

    def derivative(self, r: Float[Tensor, "*shape"]) -> Float[Tensor, "*shape"]:
        """dW/dr, 1/length^(D+1), for distances r of any shape."""
        q = r / self.smoothing_length
        scale = self._sigma() / self.smoothing_length ** (self.dim + 1)
        return torch.where(r < self.support_radius, scale * self._slope(q), 0.0)

    @abstractmethod
    def _sigma(self) -> float:
        """Normalisation σ_D."""

    @abstractmethod
    def _profile(self, q: Tensor) -> Tensor:
        """w(q) for q up to κ."""

    @abstractmethod
    def _slope(self, q: Tensor) -> Tensor:
        """w'(q) for q up to κ."""


class CubicSpline(AbstractKernel):
    r"""Cubic spline, support 2h: :math:`w = \tfrac14 (2-q)_+^3 - (1-q)_+^3`.

    Source: Monaghan, Lattanzio, "A refined particle method for astrophysical problems", A&A 149 (1985).
    """

    relative_support = 2.0

    def _sigma(self) -> float:
        return {1: 2 / 3, 2: 10 / (7 * math.pi), 3: 1 / math.pi}[self.dim]

    def _profile(self, q: Tensor) -> Tensor:
        return 0.25 * (2 - q).clamp_min(0) ** 3 - (1 - q).clamp_min(0) ** 3

    def _slope(self, q: Tensor) -> Tensor:
        return -0.75 * (2 - q).clamp_min(0) ** 2 + 3 * (1 - q).clamp_min(0) ** 2


class QuinticSpline(AbstractKernel):
    r"""Quintic spline, support 3h: :math:`w = (3-q)_+^5 - 6 (2-q)_+^5 + 15 (1-q)_+^5`.

    Source: Morris, Fox, Zhu, "Modeling low Reynolds number incompressible flows using SPH", J. Comput. Phys. 136
    (1997). The constant often printed for three dimensions, 3/(359π), is 0.28 % too large; it is 1/(120π).
    """

    relative_support = 3.0

    def _sigma(self) -> float:
        return {1: 1 / 120, 2: 7 / (478 * math.pi), 3: 1 / (120 * math.pi)}[self.dim]

    def _profile(self, q: Tensor) -> Tensor:
        return _power(3 - q, 5) - 6 * _power(2 - q, 5) + 15 * _power(1 - q, 5)

    def _slope(self, q: Tensor) -> Tensor:
        return -5 * _power(3 - q, 4) + 30 * _power(2 - q, 4) - 75 * _power(1 - q, 4)


class WendlandC2(AbstractKernel):
    r"""Wendland C2, support 2h: :math:`w = (1-q/2)^4 (1+2q)`, in one dimension :math:`(1-q/2)^3 (1+\tfrac32 q)`.

    Source: Dehnen, Aly, "Improving convergence in smoothed particle hydrodynamics simulations without pairing
    instability", MNRAS 425 (2012), table 1.
    """

    relative_support = 2.0

    def _sigma(self) -> float:
        return {1: 5 / 8, 2: 7 / (4 * math.pi), 3: 21 / (16 * math.pi)}[self.dim]

    def _profile(self, q: Tensor) -> Tensor:
        t = 1 - q / 2
        return _power(t, 3) * (1 + 1.5 * q) if self.dim == 1 else _power(t, 4) * (1 + 2 * q)

    def _slope(self, q: Tensor) -> Tensor:
        t = 1 - q / 2
        return -3 * q * _power(t, 2) if self.dim == 1 else -5 * q * _power(t, 3)


class WendlandC4(AbstractKernel):
    r"""Wendland C4, support 2h: :math:`w = (1-q/2)^6 (1+3q+\tfrac{35}{12}q^2)`.

    In one dimension :math:`w = (1-q/2)^5 (1+\tfrac52 q+2q^2)`.

    Source: Dehnen, Aly, MNRAS 425 (2012), table 1.
    """

    relative_support = 2.0

    def _sigma(self) -> float:
        return {1: 3 / 4, 2: 9 / (4 * math.pi), 3: 495 / (256 * math.pi)}[self.dim]

    def _profile(self, q: Tensor) -> Tensor:
        t = 1 - q / 2
        return _power(t, 5) * (1 + 2.5 * q + 2 * q**2) if self.dim == 1 else _power(t, 6) * (1 + 3 * q + 35 / 12 * q**2)

    def _slope(self, q: Tensor) -> Tensor:
        t = 1 - q / 2
        return -3.5 * q * _power(t, 4) * (1 + 2 * q) if self.dim == 1 else -14 / 3 * q * _power(t, 5) * (1 + 2.5 * q)


class Poly6(AbstractKernel):
    r"""Poly6, support h: :math:`w = (1-q^2)^3`.

    Source: Müller, Charypar, Gross, "Particle-based fluid simulation for interactive applications", SCA (2003),
    eq. (20).
    """

    relative_support = 1.0

    def _sigma(self) -> float:
        return {1: 35 / 32, 2: 4 / math.pi, 3: 315 / (64 * math.pi)}[self.dim]

    def _profile(self, q: Tensor) -> Tensor:
        return (1 - q**2).clamp_min(0) ** 3

    def _slope(self, q: Tensor) -> Tensor:
        return -6 * q * (1 - q**2).clamp_min(0) ** 2


class Gaussian(AbstractKernel):
    r"""Gaussian :math:`w = e^{-q^2}`, cut off at 3h and normalised over the ball that is left.

    The cut keeps the support compact, as neighbour lists need it. At 3h it leaves a jump of
    :math:`e^{-9} \approx 1.2 \cdot 10^{-4}` of the peak in W, and of :math:`6 e^{-9} / h \approx 7.4 \cdot 10^{-4} / h`
    of the peak in dW/dr. The constant is that of the ball, not of all space, so that the integral is exactly 1;
    the first moment of dW/dr misses the jump, hence D2 and D3 of a linear field are 0.04, 0.11 and 0.25 % too small in
    1, 2 and 3 dimensions, however fine the particles.

    Source: Gingold, Monaghan, "Smoothed particle hydrodynamics", MNRAS 181 (1977); the cut is ours.
    """

    relative_support = 3.0

    def _sigma(self) -> float:
        cut = self.relative_support
        inside = {
            1: math.erf(cut),
            2: 1 - math.exp(-(cut**2)),
            3: math.erf(cut) - 2 * cut / math.sqrt(math.pi) * math.exp(-(cut**2)),
        }[self.dim]
        return 1 / (math.pi ** (self.dim / 2) * inside)

    def _profile(self, q: Tensor) -> Tensor:
        return torch.exp(-(q**2))

    def _slope(self, q: Tensor) -> Tensor:
        return -2 * q * torch.exp(-(q**2))


def _power(values: Tensor, exponent: int) -> Tensor:
    """Positive part to a power, by products: from the fourth on, torch's own powers take several times as long."""
    base = values.clamp_min(0)
    return math.prod([base] * (exponent - 1), start=base)


KERNELS: dict[str, type[AbstractKernel]] = {
    "cubic_spline": CubicSpline,
    "quintic_spline": QuinticSpline,
    "wendland_c2": WendlandC2,
    "wendland_c4": WendlandC4,
    "poly6": Poly6,
    "gaussian": Gaussian,
}


def kernel_named(name: str) -> type[AbstractKernel]:
    """Kernel class of a name, e.g. "cubic_spline".

    Raises:
        ConfigError: If there is none of that name.
    """
    check_choice("kernel", name, KERNELS)
    return KERNELS[name]
