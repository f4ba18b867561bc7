"""External forces by name: accelerations as functions of the position, known to scenes, data sets and networks.

A data set declares its force in words and numbers, because code that is found beside data is never run.
"""

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, fields
from typing import ClassVar, TypeGuard

import torch
from jaxtyping import Float
from torch import Tensor

from cconv.errors import ConfigError, did_you_mean, shown

LARGEST = 1e12  # number of a declaration, in any unit
_FARTHEST = 8.0  # standard deviations, beyond which nothing is felt of a change of sign

Accelerating = Callable[[Tensor], Tensor]  # positions (N, D) to accelerations (N, D), length per time squared


@dataclass(frozen=True)
class Force(ABC):
    """An external acceleration that depends on the position alone."""

    name: ClassVar[str]

    @property
    @abstractmethod
    def largest(self) -> float:
        """Largest magnitude, length per time squared."""

    @abstractmethod
    def check(self, dim: int) -> None:
        """Check that the parameters can be, and are those of D dimensions.

        Raises:
            ConfigError: With the parameter.
        """

    @abstractmethod
    def __call__(self, positions: Float[Tensor, "N D"]) -> Float[Tensor, "N D"]:
        """Accelerations (N, D) at positions (N, D), length per time squared."""

    @abstractmethod
    def smoothed(self, deviation: float) -> Accelerating:
        """Its mean over normally distributed displacements around each position.

        Args:
            deviation: Standard deviation of each component of these, length; 0 gives the force itself.
        """

    def declaration(self) -> dict:
        """Name and parameters, as a data set declares them; `force_declared` reads them."""
        return {"name": self.name, **asdict(self)}


@dataclass(frozen=True)
class ConstantForce(Force):
    """The same acceleration everywhere, such as gravity.

    Attributes:
        acceleration: D numbers, length per time squared.
    """

    name = "constant"
    acceleration: tuple[float, ...]

    @property
    def largest(self) -> float:
        """Magnitude of the acceleration."""
        return math.hypot(*self.acceleration)

    def check(self, dim: int) -> None:
        """Check that there is one number an axis; see `Force.check`."""
        numbers = self.acceleration
        if not isinstance(numbers, tuple) or len(numbers) != dim or not all(map(_is_number, numbers)):
            raise ConfigError(f"a constant force must have {dim} numbers, got {shown(numbers)}")

    def __call__(self, positions: Float[Tensor, "N D"]) -> Float[Tensor, "N D"]:
        """The acceleration at each position."""
        return positions.new_tensor(self.acceleration).expand_as(positions)

    def smoothed(self, deviation: float) -> Accelerating:
        """The force itself, whatever the displacements; see `Force.smoothed`."""
        return self


@dataclass(frozen=True)
class ReversePoiseuilleForce(Force):
    """Forward along x in the lower half of a period in y, backward in the upper half; the sign changes at once.

    Source: Fedosov, Caswell, Karniadakis, "Reverse Poiseuille flow: the numerical viscometer" (2008); LagrangeBench
    (Toshev et al., 2023), whose flows have magnitude 1 and height 2.

    Attributes:
        magnitude: Of the acceleration, length per time squared.
        height: Period in y, length.
    """

    name = "reverse_poiseuille"
    magnitude: float
    height: float

    @property
    def largest(self) -> float:
        """The magnitude."""
        return self.magnitude

    def check(self, dim: int) -> None:
        """Check that both numbers are positive and there is an axis y; see `Force.check`."""
        if dim < 2:
            raise ConfigError(f"the force {self.name!r} must have 2 or 3 dimensions, got {dim}")
        for name, value in asdict(self).items():
            if not (_is_number(value) and value > 0):
                raise ConfigError(f"`{name}` of the force {self.name!r} must be a positive number, got {shown(value)}")

    def __call__(self, positions: Float[Tensor, "N D"]) -> Float[Tensor, "N D"]:
        """Accelerations (N, D); forward at the very middle of a period and at its beginning."""
        upper = torch.remainder(positions[:, 1], self.height) > self.height / 2
        accelerations = torch.zeros_like(positions)
        accelerations[:, 0] = torch.where(upper, -self.magnitude, self.magnitude)
        return accelerations

    def smoothed(self, deviation: float) -> Accelerating:
        r"""Its mean in closed form, a sum over the places k L/2 where the sign changes; see `Force.smoothed`.

        .. math:: g_x = g \sum_k (-1)^k \operatorname{erf} \frac{y - k L / 2}{\sqrt 2 \sigma}

        Source: the code of Neural SPH (Toshev et al., ICML 2024), which has the terms k = 0, 1, 2 in a box of height 2.
        """
        width = min(deviation, self.height)  # what is left with more is below 1e-8 of the magnitude
        beyond = math.ceil(2 * _FARTHEST * width / self.height)

        def mean(positions: Tensor) -> Tensor:
            place = torch.remainder(positions[:, 1], self.height)
            accelerations = torch.zeros_like(positions)
            for turn in range(-beyond, 3 + beyond):
                sign = -1.0 if turn % 2 else 1.0
                away = place - turn * self.height / 2
                accelerations[:, 0] += sign * self.magnitude * torch.erf(away / (math.sqrt(2) * width))
            return accelerations

        return mean if width > 0 else self


FORCES: dict[str, type[Force]] = {force.name: force for force in (ConstantForce, ReversePoiseuilleForce)}


def force_declared(declared: object, dim: int) -> Force:
    """The force that a declaration names; a list of numbers alone is a constant force.

    Args:
        declared: A mapping of `name` and the parameters of that force, or a list of D numbers.
        dim: Number of space dimensions D.

    Raises:
        ConfigError: If there is no such force, or it cannot have these parameters.
    """
    if isinstance(declared, list):
        declared = {"name": ConstantForce.name, "acceleration": declared}
    if not isinstance(declared, Mapping) or not isinstance(name := declared.get("name"), str):
        raise ConfigError(f"a force must be {dim} numbers, or its `name` and parameters, got {shown(declared)}")
    if name not in FORCES:
        raise ConfigError(f"no force {shown(name)}.{did_you_mean(name, FORCES)} Forces: {', '.join(FORCES)}")
    parameters = {key: tuple(value) if isinstance(value, list) else value for key, value in declared.items()}
    wanted = [field.name for field in fields(FORCES[name])]
    if parameters.keys() - {"name"} != set(wanted):
        raise ConfigError(f"the force {name!r} must have {' and '.join(wanted)}, got {shown(sorted(parameters))}")
    force = FORCES[name](**{key: parameters[key] for key in wanted})
    force.check(dim)
    return force


def _is_number(value: object) -> TypeGuard[float]:
    return isinstance(value, int | float) and not isinstance(value, bool) and abs(value) <= LARGEST
