"""The box that particles live in: bounds, periodic axes, minimum-image displacement and wrap."""

from dataclasses import dataclass

import torch
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
        ShapeError: If the corners differ in length or an upper bound is not above its lower one.
    """

    lower: tuple[float, ...]
    upper: tuple[float, ...]
    periodic: tuple[bool, ...]

    def __init__(self, lower, upper, periodic=False):
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

    def displacement(self, to: Tensor, origin: Tensor) -> Tensor:
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

    def wrap(self, positions: Tensor) -> Tensor:
        """Positions (..., D) with every periodic axis brought back into [lower, upper)."""
        lower = torch.as_tensor(self.lower, dtype=positions.dtype, device=positions.device)
        lengths = torch.as_tensor(self.lengths, dtype=positions.dtype, device=positions.device)
        periodic = torch.as_tensor(self.periodic, device=positions.device)
        offset = torch.remainder(positions - lower, lengths)
        # The remainder of a tiny negative number rounds to the length itself, which is the lower bound's image.
        offset = torch.where(offset >= lengths, torch.zeros_like(offset), offset)
        return torch.where(periodic, lower + offset, positions)
