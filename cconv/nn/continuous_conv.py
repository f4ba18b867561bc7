r"""The continuous convolution.

.. math::
    y_i = b + \frac{1}{\psi_i} \sum_{j \in N(i)} a_R(x_j - x_i)\, K(\Lambda(x_j - x_i))^\top m_{ij},
    \qquad m_{ij} = f_j \text{ (absolute)} \quad\text{or}\quad f_j - f_i \text{ (difference)}

Source: Ummenhofer, Prantl, Thuerey, Koltun, "Lagrangian Fluid Simulation with Continuous Convolutions" (ICLR 2020),
section 3; numerically Open3D's ContinuousConv. Difference messages are ours: D2 and D3 are sums over differences.

The geometry of a set of edges is computed once and shared by all layers with the same filter settings.
"""

import math
from functools import cached_property

import torch
from torch import Tensor, nn

from cconv.errors import ConfigError, ShapeError, check_choice, check_shape
from cconv.neighbors import Edges
from cconv.nn.filters import grid_coordinates, interpolation_weights, map_ball_to_cube, window_values
from cconv.ops.sparse_rows import SparseRows

MESSAGES = ("absolute", "difference")
INITIALIZATIONS = ("xavier_uniform", "open3d", "thesis")


class ConvGeometry:
    """Where each edge reads the filter grid, and with which weight.

    The filter radius R is the cutoff of the edges. The defaults are the published ConvNet's. As in Open3D, nothing is
    differentiated with respect to positions.

    Args:
        edges: Pairs of receivers i and senders j.
        kernel_size: Cells of the filter grid: one number for all axes, or (depth, height, width) / (height, width).
        mapping: Coordinate map Λ: "identity", "ball_to_cube_radial" or "ball_to_cube_volume_preserving".
        window: Radial weight a_R: "none", "poly6", "gaussian" or "cubic_spline".
        interpolation: "linear", "nearest_neighbor" or "linear_border".
        align_corners: Whether the outermost cells' centres lie on the faces of the cube.
        normalize: Whether to divide by ψ, the sum of a receiver's window values (thesis eq. 2.31).

    Attributes:
        cells: Filter cells that each edge reads, (E, P), int32.
        weights: Their weights, window and 1/ψ included, (E, P).

    Raises:
        ConfigError: If a name is unknown or the kernel size is not positive.
    """

    def __init__(
        self,
        edges: Edges,
        kernel_size: int | tuple[int, ...],
        mapping: str = "ball_to_cube_volume_preserving",
        window: str = "poly6",
        interpolation: str = "linear",
        align_corners: bool = True,
        normalize: bool = False,
    ):
        self.kernel_size = grid_shape(kernel_size, edges.dim)
        self.row_splits = edges.row_splits
        self.receivers, self.senders = edges.receivers, edges.senders
        self.num_senders = edges.num_senders
        self.bipartite = edges.bipartite
        sizes = self.kernel_size[::-1]
        cube = map_ball_to_cube(-edges.displacements / edges.cutoff, mapping)  # Λ takes x_j - x_i
        cells, weights = interpolation_weights(grid_coordinates(cube, sizes, align_corners), sizes, interpolation)
        importance = window_values((edges.distances / edges.cutoff) ** 2, window)
        if normalize:
            importance = importance / _row_sums(importance, edges)[edges.receivers]
        self.cells, self.weights = cells.int(), (weights * importance[:, None]).detach()

    @property
    def num_receivers(self) -> int:
        """Number of receiving points."""
        return len(self.row_splits) - 1

    @property
    def num_cells(self) -> int:
        """Number of cells of the filter grid, K^D."""
        return math.prod(self.kernel_size)

    @property
    def nbytes(self) -> int:
        """Memory in bytes once every matrix has been asked for."""
        entries, places = self.cells.numel(), (self.num_receivers + self.num_senders) * self.num_cells
        matrices = 4 * entries * (4 + self.weights.element_size()) + 2 * 4 * places
        sums = self.num_receivers * self.num_cells * self.weights.element_size()
        return matrices + sums + sum(t.nbytes for t in (self.cells, self.weights, self.receivers, self.senders))

    @cached_property
    def gather(self) -> SparseRows:
        """Matrix (receivers · K^D, senders) that gathers features into filter cells."""
        rows = self.receivers[:, None] * self.num_cells + self.cells
        columns = self.senders[:, None].expand_as(rows)
        shape = (self.num_receivers * self.num_cells, self.num_senders)
        return SparseRows.from_entries(rows.flatten(), columns.flatten(), self.weights.flatten(), shape)

    @cached_property
    def read(self) -> SparseRows:
        """Matrix (receivers, senders · K^D) that reads features already multiplied with the filter of each cell."""
        columns = self.senders[:, None] * self.num_cells + self.cells
        points = self.cells.shape[1]
        return SparseRows(
            (self.row_splits * points).int(),
            columns.flatten().int(),
            self.weights.flatten(),
            self.num_senders * self.num_cells,
        )

    @cached_property
    def cell_sums(self) -> Tensor:
        """Weights summed over the neighbours in each cell, (receivers, K^D)."""
        sums = self.weights.new_zeros(self.num_receivers * self.num_cells)
        rows = self.receivers[:, None] * self.num_cells + self.cells
        return sums.index_add_(0, rows.flatten(), self.weights.flatten()).reshape(self.num_receivers, self.num_cells)


def grid_shape(kernel_size: int | tuple[int, ...], dim: int) -> tuple[int, ...]:
    """Filter grid (depth, height, width) of `dim` axes from one number or one for each axis.

    Raises:
        ConfigError: If a size is not a positive whole number or the number of axes differs.
    """
    shape = (kernel_size,) * dim if isinstance(kernel_size, int) else tuple(kernel_size)
    if len(shape) != dim or not all(isinstance(size, int) and size >= 1 for size in shape):
        raise ConfigError(f"`kernel_size` must be a positive whole number or {dim} of them, got {kernel_size!r}.")
    return shape


def _row_sums(importance: Tensor, edges: Edges) -> Tensor:
    sums = importance.new_zeros(edges.num_receivers).index_add_(0, edges.receivers, importance)
    return torch.where(sums == 0, 1.0, sums)


def continuous_conv(
    features: Tensor, filters: Tensor, geometry: ConvGeometry, bias: Tensor | None = None, message: str = "absolute"
) -> Tensor:
    """Continuous convolution of `features` with `filters`; equation in the module's docstring.

    Args:
        features: Features f of the senders (M, C_in).
        filters: Filter grid in Open3D's layout (depth, height, width, C_in, C_out), in 2D (height, width, C_in, C_out).
        geometry: Where each edge reads the filter grid.
        bias: (C_out,) or None.
        message: "absolute" or "difference"; the latter needs receivers and senders to be the same points.

    Returns:
        (N, C_out); a receiver without neighbours gives the bias.

    Raises:
        ShapeError: If shapes, dtypes or devices do not fit together.
        ConfigError: If the message is unknown or not possible.
    """
    _check_inputs(features, filters, geometry, bias, message)
    in_channels, out_channels = filters.shape[-2:]
    if out_channels < in_channels:
        output = _multiply_then_read(features, filters.reshape(-1, in_channels, out_channels), geometry, message)
    else:
        output = _gather_then_multiply(features, filters.reshape(-1, out_channels), geometry, message)
    return output if bias is None else output + bias


def _gather_then_multiply(features: Tensor, filters: Tensor, geometry: ConvGeometry, message: str) -> Tensor:
    columns = (geometry.gather @ features).reshape(geometry.num_receivers, geometry.num_cells, features.shape[1])
    if message == "difference":
        columns = columns - geometry.cell_sums[:, :, None] * features[:, None, :]
    return columns.flatten(1) @ filters


def _multiply_then_read(features: Tensor, filters: Tensor, geometry: ConvGeometry, message: str) -> Tensor:
    num_cells, in_channels, out_channels = filters.shape
    products = features @ filters.transpose(0, 1).reshape(in_channels, num_cells * out_channels)
    output = geometry.read @ products.reshape(-1, out_channels)
    if message == "difference":
        own = products.reshape(-1, num_cells, out_channels)
        output = output - torch.einsum("nk,nko->no", geometry.cell_sums, own)
    return output


def _check_inputs(features: Tensor, filters: Tensor, geometry: ConvGeometry, bias: Tensor | None, message: str) -> None:
    check_choice("message", message, MESSAGES)
    if message == "difference" and geometry.bipartite:
        raise ConfigError("`message` must be 'absolute' where receivers and senders are different points.")
    check_shape("filters", filters.shape, (*geometry.kernel_size, "in_channels", "out_channels"))
    check_shape("features", features.shape, (geometry.num_senders, filters.shape[-2]))
    if bias is not None:
        check_shape("bias", bias.shape, (filters.shape[-1],))
    for name, tensor in (("features", features), ("filters", filters)):
        if tensor.dtype != geometry.weights.dtype or tensor.device != geometry.weights.device:
            raise ShapeError(
                f"`{name}` must share dtype and device with the geometry ({geometry.weights.dtype}, "
                f"{geometry.weights.device}), got {tensor.dtype}, {tensor.device}."
            )


class ContinuousConv(nn.Module):
    """A continuous convolution with learned filters; equation in the module's docstring.

    Args:
        in_channels: C_in.
        out_channels: C_out.
        kernel_size: Cells of the filter grid, one number or one for each axis.
        dim: Number of space dimensions D.
        bias: Whether to add a learned bias, 0 at first.
        message: "absolute" or "difference".
        initialization: "xavier_uniform" (thesis; fans count the whole grid), "open3d" (uniform in ±0.05) or "thesis"
            (as "xavier_uniform"; it differs for linear layers only).
        generator: Source of the initial weights; None for torch's global one.
    """

    def __init__(
        self,
        in_channels: int,
        out_channels: int,
        kernel_size: int | tuple[int, ...],
        dim: int,
        *,
        bias: bool = True,
        message: str = "absolute",
        initialization: str = "xavier_uniform",
        generator: torch.Generator | None = None,
    ):
        super().__init__()
        check_choice("message", message, MESSAGES)
        check_choice("initialization", initialization, INITIALIZATIONS)
        self.message = message
        shape = grid_shape(kernel_size, dim)
        self.filters = nn.Parameter(torch.empty(*shape, in_channels, out_channels))
        self.bias = nn.Parameter(torch.zeros(out_channels)) if bias else None
        fans = math.prod(shape) * (in_channels + out_channels)
        bound = 0.05 if initialization == "open3d" else math.sqrt(6 / fans)
        nn.init.uniform_(self.filters, -bound, bound, generator=generator)

    def forward(self, features: Tensor, geometry: ConvGeometry) -> Tensor:
        """Features (M, C_in) of the senders to (N, C_out) at the receivers."""
        return continuous_conv(features, self.filters, geometry, self.bias, self.message)
