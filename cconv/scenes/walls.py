"""Wall particles around the inside of a box, and the relaxed particles within."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from cconv.errors import ConfigError

WALL_LAYERS = 3  # the quintic spline reaches three particle spacings


@dataclass(frozen=True, kw_only=True)
class Walls:
    """Wall particles. The solver needs several layers; data sets keep those that touch the fluid.

    Attributes:
        positions: (W, D).
        velocities: At which the wall moves (W, D).
        stored: Which particles data sets keep (W,), bool.
    """

    positions: Tensor
    velocities: Tensor
    stored: Tensor

    @staticmethod
    def none(dim: int) -> "Walls":
        """No walls."""
        return Walls(
            positions=torch.zeros(0, dim, dtype=torch.float64),
            velocities=torch.zeros(0, dim, dtype=torch.float64),
            stored=torch.zeros(0, dtype=torch.bool),
        )

    def __len__(self) -> int:
        return len(self.positions)


def whole_cells(length: float, spacing: float) -> int:
    """How many particles fill a length.

    Raises:
        ConfigError: If the spacing does not divide it.
    """
    cells = round(length / spacing)
    if cells < 1 or abs(cells * spacing - length) > 1e-4 * spacing * cells:
        raise ConfigError(
            f"`particle_spacing` must divide the length {length:g} of the scene, got {spacing:g}; take "
            f"{length / max(cells, 1):.6g}."
        )
    return cells


def lattice(counts: Sequence[int], spacing: float, lower: Sequence[float]) -> Tensor:
    """Cell centres of a lattice (N, D), float64, whose first cell has its corner at `lower`."""
    axes = [(torch.arange(count, dtype=torch.float64) + 0.5) * spacing for count in counts]
    return torch.cartesian_prod(*axes).reshape(-1, len(counts)) + torch.tensor(lower, dtype=torch.float64)


def walls_around(
    counts: Sequence[int], spacing: float, lower: Sequence[float], closed: Sequence[bool] | None = None
) -> Walls:
    """Walls at rest around `counts` cells from the corner `lower` on, on the axes that are closed (all by default)."""
    closed = closed or [True] * len(counts)
    layers = [WALL_LAYERS if is_closed else 0 for is_closed in closed]
    outer = lattice(
        [count + 2 * layer for count, layer in zip(counts, layers, strict=True)],
        spacing,
        [low - layer * spacing for low, layer in zip(lower, layers, strict=True)],
    )
    cells = (outer - torch.tensor(lower, dtype=torch.float64)) / spacing
    beyond = torch.maximum(-cells, cells - torch.tensor(counts, dtype=torch.float64)).amax(dim=1)
    return Walls(
        positions=outer[beyond > 0],
        velocities=torch.zeros_like(outer[beyond > 0]),
        stored=beyond[beyond > 0] < 1,
    )
