"""The box that particles live in: bounds, periodic axes, minimum-image displacement and wrap."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from cconv.errors import ShapeError


@dataclass(frozen=True)
class Box:
    """An axis-aligned box, each axis periodic or open.

    Open axes do not confine particles: their bounds only say where the scene is.

    Args:
        lower: Lower corner, D numbers (length units of the scene).
        upper: Upper corner, D numbers.
        periodic: One truth value for all axes, or one for each.

    Raises:
        ShapeError: If the corners differ in length, an upper bound is not above its lower one, or a periodic axis is
            not finite.
    """

    lower: tuple[float, ...]
    upper: tuple[float, ...]
    periodic: tuple[bool, ...]

    def __init__(self, lower: Sequence[float], upper: Sequence[float], periodic: bool | Sequence[bool] = False):
        lower = tuple(float(value) for value in lower)
        upper = tuple(float(value) for value in upper)
        periodic = (periodic,) * len(lower) if isinstance(periodic, bool) else tuple(bool(axis) for axis in periodic)
        if not len(lower) == len(upper) == len(periodic):
            raise ShapeError(
                "`lower`, `upper` and `periodic` must have one entry an axis, "
                f"got {len(lower)}, {len(upper)} and {len(periodic)}."
            )
        if not all(low < high for low, high in zip(lower, upper, strict=True)):
            raise ShapeError(f"`upper` must lie above `lower` on every axis, got {lower} and {upper}.")
        for low, high, wraps in zip(lower, upper, periodic, strict=True):
            if wraps and not math.isfinite(high - low):
                raise ShapeError(f"`lower` and `upper` must be finite on a periodic axis, got {low} and {high}.")
        object.__setattr__(self, "lower", lower)
        object.__setattr__(self, "upper", upper)
        object.__setattr__(self, "periodic", periodic)

    @property
    def dim(self) -> int:
        """Number of axes D."""
        return len(self.lower)

    @property
    def lengths(self) -> tuple[float, ...]:
        """Edge lengths, D numbers."""
        return tuple(high - low for low, high in zip(self.lower, self.upper, strict=True))

    @property
    def shortest_period(self) -> float:
        """Length of the shortest periodic axis; infinite without one."""
        return min(
            (length for length, wraps in zip(self.lengths, self.periodic, strict=True) if wraps), default=math.inf
        )

    def displacement(
        self, to: Float[Tensor, "*#points D"], origin: Float[Tensor, "*#points D"]
    ) -> Float[Tensor, "... D"]:
        """Minimum-image displacement ``to - origin``.

        Args:
            to: Positions (..., D).
            origin: Positions that broadcast against `to`.

        Returns:
            Displacements (..., D); on a periodic axis of length L within [-L/2, L/2].
        """
        difference = to - origin
        if not any(self.periodic):
            return difference
        lengths = torch.as_tensor(self.lengths, dtype=difference.dtype, device=difference.device)
        periodic = torch.as_tensor(self.periodic, device=difference.device)
        return difference - torch.where(periodic, lengths * torch.round(difference / lengths), 0.0)

    def wrap(self, positions: Float[Tensor, "*points {self.dim}"]) -> Float[Tensor, "*points {self.dim}"]:
        """Positions (..., D) with every periodic axis brought back into [lower, upper)."""
        lower = torch.as_tensor(self.lower, dtype=positions.dtype, device=positions.device)
        lengths = torch.as_tensor(self.lengths, dtype=positions.dtype, device=positions.device)
        periodic = torch.as_tensor(self.periodic, device=positions.device)
        upper = torch.as_tensor(self.upper, dtype=positions.dtype, device=positions.device)
        wrapped = lower + torch.remainder(positions - lower, lengths)
        # Rounding can reach the upper bound itself, which is the lower bound's image.
        wrapped = torch.where(wrapped >= upper, lower, wrapped)
        return torch.where(periodic, wrapped, positions)
