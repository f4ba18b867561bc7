r"""How a displacement finds its place in a filter grid: coordinate map, window, interpolation.

All three follow Open3D's ContinuousConv, the operator of Ummenhofer et al., "Lagrangian Fluid Simulation with
Continuous Convolutions" (ICLR 2020), section 3. Coordinates are ordered (x, y, z), filter axes (depth, height, width).
Two-dimensional maps are the three-dimensional ones at z = 0.
"""

import itertools
import math
from collections.abc import Callable

import torch
from jaxtyping import Float, Int32
from torch import Tensor

from cconv.errors import check_choice

_TINY = 1e-12


def _identity(ball: Tensor) -> Tensor:
    return ball


def _ball_to_cube_radial(ball: Tensor) -> Tensor:
    largest = ball.abs().amax(dim=-1, keepdim=True)
    norm = torch.linalg.vector_norm(ball, dim=-1, keepdim=True)
    return torch.where(largest < 1e-8, 0.0, ball * norm / largest.clamp_min(1e-8))


def _ball_to_cube_volume_preserving(ball: Tensor) -> Tensor:
    if ball.shape[-1] == 1:
        return ball
    if ball.shape[-1] == 2:
        return torch.stack(_disk_to_square(*ball.unbind(-1)), dim=-1)
    x, y, z = _ball_to_cylinder(*ball.unbind(-1))
    return torch.stack([*_disk_to_square(x, y), z], dim=-1)


def _ball_to_cylinder(x: Tensor, y: Tensor, z: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    rho_squared = x * x + y * y
    norm_squared = rho_squared + z * z
    origin = norm_squared < _TINY
    norm = torch.where(origin, 1.0, norm_squared).sqrt()
    cap = 1.25 * z * z > rho_squared
    on_cap = (3 * norm / (norm + z.abs())).sqrt()
    on_side = norm / torch.where(cap | origin, 1.0, rho_squared).sqrt()
    scale = torch.where(cap, on_cap, on_side)
    height = torch.where(cap, torch.sign(z) * norm, 1.5 * z)
    x, y, z = (torch.where(origin, 0.0, value) for value in (scale * x, scale * y, height))
    return x, y, z


def _disk_to_square(x: Tensor, y: Tensor) -> tuple[Tensor, Tensor]:
    rho_squared = x * x + y * y
    flat = y.abs() <= x.abs()
    longer, shorter = torch.where(flat, x, y), torch.where(flat, y, x)
    origin = rho_squared < _TINY
    side = torch.sign(longer) * torch.where(origin, 1.0, rho_squared).sqrt()
    other = side * (4 / math.pi) * torch.atan(shorter / torch.where(origin, 1.0, longer))
    side, other = torch.where(origin, 0.0, side), torch.where(origin, 0.0, other)
    return torch.where(flat, side, other), torch.where(flat, other, side)


MAPPINGS: dict[str, Callable[[Tensor], Tensor]] = {
    "identity": _identity,
    "ball_to_cube_radial": _ball_to_cube_radial,
    "ball_to_cube_volume_preserving": _ball_to_cube_volume_preserving,
}


def map_ball_to_cube(ball: Float[Tensor, "E D"], mapping: str) -> Float[Tensor, "E D"]:
    """Coordinate map Λ from the unit ball to the cube [-1/2, 1/2]^D.

    Args:
        ball: Positions q in the unit ball (E, D), D from 1 to 3.
        mapping: "identity", "ball_to_cube_radial" or "ball_to_cube_volume_preserving".

    Returns:
        Coordinates u (E, D).

    Raises:
        ConfigError: If the mapping is unknown.
    """
    check_choice("mapping", mapping, MAPPINGS)
    return 0.5 * MAPPINGS[mapping](ball)


def _cubic_spline_window(squared: Tensor) -> Tensor:
    q = 2 * squared.clamp_min(1e-30).sqrt()  # the root has no derivative at 0
    return torch.where(q < 1, 1 - 1.5 * q**2 + 0.75 * q**3, 0.25 * (2 - q).clamp_min(0) ** 3)


WINDOWS: dict[str, Callable[[Tensor], Tensor]] = {
    "none": torch.ones_like,  # thesis eq. (2.28)
    "poly6": lambda squared: (1 - squared).clamp(0, 1) ** 3,  # thesis eq. (2.29)
    "gaussian": lambda squared: torch.exp(-squared),  # thesis eq. (2.30)
    "cubic_spline": _cubic_spline_window,  # Monaghan's kernel with support R, 1 at the centre
}


def window_values(squared: Float[Tensor, "*shape"], window: str) -> Float[Tensor, "*shape"]:
    """Window a_R of the squared relative distance (r/R)², for r up to R.

    Args:
        squared: (r/R)², any shape.
        window: "none", "poly6", "gaussian" or "cubic_spline".

    Returns:
        Values of the same shape, 1 at the centre.

    Raises:
        ConfigError: If the window is unknown.
    """
    check_choice("window", window, WINDOWS)
    return WINDOWS[window](squared)


def grid_coordinates(cube: Float[Tensor, "E D"], sizes: tuple[int, ...], align_corners: bool) -> Float[Tensor, "E D"]:
    """Coordinates g on the filter grid, cell centres at the whole numbers 0 ... F-1.

    Args:
        cube: Coordinates u in [-1/2, 1/2]^D, (E, D).
        sizes: Number of cells F along x, y, z.
        align_corners: Whether the outermost cells' centres (True) or their outer faces (False) lie on the cube's faces.

    Returns:
        g, (E, D).
    """
    cells = cube.new_tensor(sizes)
    return (cube + 0.5) * (cells - 1) if align_corners else (cube + 0.5) * cells - 0.5


def _linear(grid: Tensor, sizes: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    lower = torch.minimum(grid.detach().trunc().clamp_min(0), (sizes - 2).clamp_min(0))
    return lower.int(), (grid - lower).clamp(0, 1), torch.ones_like(grid[:, 0])


def _nearest_neighbor(grid: Tensor, sizes: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    whole = grid.detach().trunc()
    rounded = whole + (2 * (grid.detach() - whole)).trunc()  # exact, where adding a half would round 0.49999997 up
    cells = torch.minimum(rounded.clamp_min(0), sizes - 1)
    return cells.int(), grid[:, :0], torch.ones_like(grid[:, 0])


def _linear_border(grid: Tensor, sizes: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    # Between the outermost centres as "linear"; beyond them the only cell inside the grid loses weight.
    lower, fractions, _ = _linear(torch.minimum(grid.clamp_min(0), sizes - 1), sizes)
    return lower, fractions, torch.minimum(1 + grid, sizes - grid).clamp(0, 1).prod(dim=1)


INTERPOLATIONS: dict[str, Callable[[Tensor, Tensor], tuple[Tensor, Tensor, Tensor]]] = {
    "linear": _linear,
    "nearest_neighbor": _nearest_neighbor,
    "linear_border": _linear_border,
}


def interpolate(
    grid: Float[Tensor, "E D"], sizes: tuple[int, ...], interpolation: str
) -> tuple[Int32[Tensor, "E D"], Float[Tensor, "E A"], Float[Tensor, " E"]]:
    """Cells that a grid coordinate reads.

    Args:
        grid: Grid coordinates g (E, D).
        sizes: Number of cells F along x, y, z.
        interpolation: "linear" (clamped at the border), "nearest_neighbor" (halves round away from zero, clamped) or
            "linear_border" (cells outside the grid weigh 0).

    Returns:
        Lowest cell along each axis (E, D), int32; fraction f along each axis (E, D), so that the cell above weighs f
        and the lowest 1 - f, or (E, 0) where only one cell is read; weight of the whole read (E,).

    Raises:
        ConfigError: If the interpolation is unknown.
    """
    check_choice("interpolation", interpolation, INTERPOLATIONS)
    return INTERPOLATIONS[interpolation](grid, grid.new_tensor(sizes))


def strides(sizes: tuple[int, ...]) -> tuple[int, ...]:
    """Steps of the linear cell index along x, y, z: z · F_y · F_x + y · F_x + x."""
    return tuple(itertools.accumulate(sizes[:-1], lambda stride, size: stride * size, initial=1))


def corner_offsets(sizes: tuple[int, ...]) -> list[int]:
    """Offsets of the 2^D cells around a grid coordinate; an axis of a single cell has no cell above."""
    steps = [stride if size > 1 else 0 for stride, size in zip(strides(sizes), sizes, strict=True)]
    corners = range(2 ** len(sizes))
    return [sum(step for axis, step in enumerate(steps) if corner >> axis & 1) for corner in corners]
