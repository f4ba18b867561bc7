r"""The continuous convolution.

.. math::
    y_i = b + \frac{1}{\psi_i} \sum_{j \in N(i)} a_R(x_j - x_i)\, K(\Lambda(x_j - x_i))^\top m_{ij},
    \qquad m_{ij} = f_j + \sigma f_i

with σ = 0 for "absolute", -1 for "difference" and 1 for "sum" messages.

Source: Ummenhofer, Prantl, Thuerey, Koltun, "Lagrangian Fluid Simulation with Continuous Convolutions" (ICLR 2020),
section 3; numerically Open3D's ContinuousConv. Difference messages are ours: D2 and D3 are sums over differences.
Sums come from Prantl et al., "Guaranteed Conservation of Momentum for Learning Particle-based Fluid Dynamics" (NeurIPS
2022).

The geometry of a set of edges is computed once and shared by all layers with the same filter settings.
"""

import math
from collections.abc import Sequence
from copy import copy

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from cconv.errors import ConfigError, ShapeError, check_choice, check_shape
from cconv.neighbors import Edges
from cconv.nn.filters import (
    corner_offsets,
    grid_coordinates,
    interpolate,
    map_ball_to_cube,
    strides,
    window_values,
)
from cconv.ops.convolution import convolve
from cconv.ops.filter_reads import FilterReads, join_reads

MESSAGES = {"absolute": 0, "difference": -1, "sum": 1}
INITIALIZATIONS = ("xavier_uniform", "open3d", "thesis")
CENTERS = ("none", "cell", "dense")


class ConvGeometry:
    """Where each edge reads the filter grid, and with which weight.

    The filter radius R is the cutoff of the edges. The defaults are the published ConvNet's.

    Args:
        edges: Pairs of receivers i and senders j.
        kernel_size: Cells of the filter grid: one number for all axes, or (depth, height, width) / (height, width).
        mapping: Coordinate map Λ: "identity", "ball_to_cube_radial" or "ball_to_cube_volume_preserving".
        window: Radial weight a_R: "none", "poly6", "gaussian" or "cubic_spline".
        interpolation: "linear", "nearest_neighbor" or "linear_border".
        align_corners: Whether the outermost cells' centres lie on the faces of the cube.
        normalize: Whether to divide by ψ, the sum of a receiver's window values (thesis eq. 2.31).
        detach_positions: Whether to hold positions constant, as Open3D does. Otherwise, edges of positions that require
            gradients make convolutions differentiable with respect to them; these take the slower general path.

    Attributes:
        kernel_size: Cells along each filter axis.
        normalize: As given.
        bipartite: Whether receivers and senders are different points.
        includes_self: Whether each particle is its own neighbour.
        reads: Cells and weights of each edge.

    Raises:
        ConfigError: If a name is unknown or the kernel size is not positive.
        ShapeError: If the edges do not fit together or hold values that are not finite.
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
        detach_positions: bool = False,
    ):
        edges.check()
        self.kernel_size = grid_shape(kernel_size, edges.dim)
        self.normalize = normalize
        self.bipartite, self.includes_self = edges.bipartite, edges.includes_self
        with torch.set_grad_enabled(torch.is_grad_enabled() and not detach_positions):
            self.reads = _filter_reads(
                edges, self.kernel_size, mapping, window, interpolation, align_corners, normalize
            )

    def joined_with(self, others: "Sequence[ConvGeometry]") -> "ConvGeometry":
        """The geometry of this window and of others in one graph; all with the same settings."""
        joined = copy(self)
        joined.reads = join_reads([self.reads, *(other.reads for other in others)])
        return joined

    @property
    def num_receivers(self) -> int:
        """Number of receiving points."""
        return self.reads.num_receivers

    @property
    def num_senders(self) -> int:
        """Number of sending points."""
        return self.reads.num_senders

    @property
    def num_cells(self) -> int:
        """Number of cells of the filter grid, K^D."""
        return self.reads.num_cells

    @property
    def neighbor_counts(self) -> Int[Tensor, " N"]:
        """Number of neighbours of each receiver, itself not counted, (N,)."""
        return self.reads.row_splits.diff() - int(self.includes_self)

    @property
    def nbytes(self) -> int:
        """Memory in bytes, also of what convolutions add on first use."""
        return self.reads.nbytes


def _filter_reads(
    edges: Edges,
    kernel_size: tuple[int, ...],
    mapping: str,
    window: str,
    interpolation: str,
    align_corners: bool,
    normalize: bool,
) -> FilterReads:
    sizes = kernel_size[::-1]
    cube = map_ball_to_cube(-edges.displacements / edges.cutoff, mapping)  # Λ takes x_j - x_i
    lowest, fractions, factor = interpolate(grid_coordinates(cube, sizes, align_corners), sizes, interpolation)
    return FilterReads(
        row_splits=edges.row_splits,
        receivers=edges.receivers,
        senders=edges.senders,
        cells=sum(map(torch.mul, lowest.unbind(1), strides(sizes)), start=torch.zeros_like(lowest[:, 0])),
        fractions=fractions,
        weights=importance(edges, window, normalize) * factor,
        corner_offsets=tuple(corner_offsets(sizes)[: 2 ** fractions.shape[1]]),
        num_cells=math.prod(sizes),
        num_senders=edges.num_senders,
    )


def grid_shape(kernel_size: int | tuple[int, ...], dim: int) -> tuple[int, ...]:
    """Filter grid (depth, height, width) of `dim` axes from one number or one for each axis.

    Raises:
        ConfigError: If a size is not a positive whole number or the number of axes differs.
    """
    shape = tuple(kernel_size) if isinstance(kernel_size, Sequence) else (kernel_size,) * dim
    if len(shape) != dim or not all(isinstance(size, int) and size >= 1 for size in shape):
        raise ConfigError(f"`kernel_size` must be a positive whole number or {dim} of them, got {kernel_size!r}.")
    return shape


def importance(edges: Edges, window: str, normalize: bool) -> Float[Tensor, " E"]:
    """Window a_R of each edge (E,), divided by ψ of its receiver if `normalize`."""
    values = window_values((edges.distances / edges.cutoff) ** 2, window)
    if not normalize:
        return values
    sums = values.new_zeros(edges.num_receivers).index_add(0, edges.receivers, values)
    return values / torch.where(sums == 0, 1.0, sums)[edges.receivers]


def continuous_conv(
    features: Float[Tensor, "M C_in"],
    filters: Float[Tensor, "*cells C_in C_out"],
    geometry: ConvGeometry,
    bias: Float[Tensor, " C_out"] | None = None,
    message: str = "absolute",
) -> Float[Tensor, "N C_out"]:
    """Continuous convolution of `features` with `filters`; equation in the module's docstring.

    On the CPU in float32 or float64, compiled loops over blocks of particles keep memory independent of their number
    and follow `torch.get_num_threads()`. Other devices and dtypes, derivatives with respect to positions, and second
    derivatives go through torch operations.

    Args:
        features: Features f of the senders (M, C_in), finite.
        filters: Filter grid in Open3D's layout (depth, height, width, C_in, C_out), in 2D (height, width, C_in, C_out).
        geometry: Where each edge reads the filter grid.
        bias: (C_out,) or None.
        message: "absolute", "difference" or "sum"; the latter two need receivers and senders to be the same points.

    Returns:
        (N, C_out); a receiver without neighbours gives the bias.

    Raises:
        ShapeError: If shapes, dtypes or devices do not fit together, or a feature is not finite.
        ConfigError: If the message is unknown or not possible.
    """
    _check_inputs(features, filters, geometry, bias, message)
    check_finite("features", features)
    return _continuous_conv(features, filters, geometry, bias, message)


def check_finite(name: str, tensor: Tensor) -> None:
    """Require finite values; a compiled graph cannot ask, and does not.

    Raises:
        ShapeError: If a value is NaN or infinite.
    """
    if torch.compiler.is_compiling() or math.isfinite(_sum(tensor.detach())):  # far cheaper than asking each value
        return
    if not torch.isfinite(tensor).all():
        place = [int(index) for index in torch.nonzero(~torch.isfinite(tensor))[0]]
        raise ShapeError(
            f"`{name}` must be finite, got {tensor[tuple(place)].item()} at {place}; look for a division by zero or a "
            "simulation that blew up."
        )


def _sum(tensor: Tensor) -> float:
    if tensor.device.type != "cpu" or tensor.dtype not in (torch.float32, torch.float64):
        return tensor.sum().item()
    with np.errstate(all="ignore"):  # one pass on this thread, without waking torch's others
        return float(tensor.numpy().sum())


def _continuous_conv(
    features: Tensor, filters: Tensor, geometry: ConvGeometry, bias: Tensor | None, message: str
) -> Tensor:
    output = convolve(features, filters.flatten(0, -3), geometry.reads, MESSAGES[message])
    return output if bias is None else output + bias


def _check_inputs(features: Tensor, filters: Tensor, geometry: ConvGeometry, bias: Tensor | None, message: str) -> None:
    check_choice("message", message, MESSAGES)
    if message != "absolute" and geometry.bipartite:
        raise ConfigError("`message` must be 'absolute' where receivers and senders are different points.")
    check_shape("filters", filters.shape, (*geometry.kernel_size, "in_channels", "out_channels"))
    check_shape("features", features.shape, (geometry.num_senders, filters.shape[-2]))
    if bias is not None:
        check_shape("bias", bias.shape, (filters.shape[-1],))
    check_kind(geometry.reads.weights, features=features, filters=filters, bias=bias)


def check_kind(expected: Tensor, **tensors: Tensor | None) -> None:
    """Require dtype and device of the geometry's tensor `expected`.

    Raises:
        ShapeError: If one of `tensors` differs.
    """
    for name, tensor in tensors.items():
        if tensor is not None and (tensor.dtype != expected.dtype or tensor.device != expected.device):
            raise ShapeError(
                f"`{name}` must share dtype and device with the geometry ({expected.dtype}, {expected.device}), "
                f"got {tensor.dtype}, {tensor.device}."
            )


def uniform_filters(
    shape: tuple[int, ...],
    in_channels: int,
    out_channels: int,
    generator: torch.Generator | None,
    bound: float | None = None,
) -> nn.Parameter:
    """Filters (*shape, C_in, C_out), uniform in ±bound; None for Xavier's, whose fans count the whole shape."""
    filters = nn.Parameter(torch.empty(*shape, in_channels, out_channels))
    fans = math.prod(shape) * max(in_channels + out_channels, 1)
    bound = math.sqrt(6 / fans) if bound is None else bound
    nn.init.uniform_(filters, -bound, bound, generator=generator)
    return filters


class ContinuousConv(nn.Module):
    """A continuous convolution with learned filters; equation in the module's docstring.

    Args:
        in_channels: C_in.
        out_channels: C_out.
        kernel_size: Cells of the filter grid, one number or one for each axis.
        dim: Number of space dimensions D.
        bias: Whether to add a learned bias, 0 at first.
        message: "absolute", "difference" or "sum".
        center: What a particle adds to its own output besides its neighbours: "none"; "cell", its features through the
            filter at r = 0 (odd kernel sizes only, and edges without the particle itself); "dense", its features
            through a learned matrix of their own, as Open3D's `use_dense_layer_for_center`.
        initialization: "xavier_uniform" (thesis; fans count the whole grid), "open3d" (uniform in ±0.05) or "thesis"
            (as "xavier_uniform"; it differs for linear layers only).
        generator: Source of the initial weights; None for torch's global one.

    Raises:
        ConfigError: If a name is unknown, a size is not positive, or "cell" comes with an even kernel size.
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
        center: str = "none",
        initialization: str = "xavier_uniform",
        generator: torch.Generator | None = None,
    ):
        super().__init__()
        check_choice("message", message, MESSAGES)
        check_choice("center", center, CENTERS)
        check_choice("initialization", initialization, INITIALIZATIONS)
        shape = grid_shape(kernel_size, dim)
        if center == "cell" and not all(size % 2 for size in shape):
            raise ConfigError(f"`center` 'cell' needs odd kernel sizes, got {shape}; take 'dense' with even ones.")
        self.message, self.center = message, center
        bound = 0.05 if initialization == "open3d" else None
        self.filters = uniform_filters(shape, in_channels, out_channels, generator, bound)
        self.bias = nn.Parameter(torch.zeros(out_channels)) if bias else None
        self.center_weights = None
        if center == "dense":
            self.center_weights = nn.Parameter(torch.empty(in_channels, out_channels))
            nn.init.xavier_uniform_(self.center_weights, generator=generator)

    def forward(self, features: Float[Tensor, "M C_in"], geometry: ConvGeometry) -> Float[Tensor, "N C_out"]:
        """Features (M, C_in) of the senders to (N, C_out) at the receivers; errors as of `continuous_conv`."""
        _check_inputs(features, self.filters, geometry, self.bias, self.message)
        check_finite("features", features)
        return self.convolve(features, geometry)

    def convolve(self, features: Float[Tensor, "M C_in"], geometry: ConvGeometry) -> Float[Tensor, "N C_out"]:
        """`forward` without its checks, for hidden layers: what diverged weights make of good inputs passes on."""
        if self.center != "none" and (geometry.bipartite or geometry.includes_self):
            raise ConfigError(
                f"`center` {self.center!r} needs receivers and senders to be the same points and edges without the "
                "particle itself (`include_self=False`)."
            )
        output = _continuous_conv(features, self.filters, geometry, self.bias, self.message)
        if self.center == "none":
            return output
        return output + features @ (self._center_cell if self.center_weights is None else self.center_weights)

    @property
    def _center_cell(self) -> Tensor:
        return self.filters[tuple(size // 2 for size in self.filters.shape[:-2])]


def antisymmetric_filters(filters: Float[Tensor, "*shape"]) -> Float[Tensor, "*shape"]:
    """The part of a filter grid that changes sign at the origin, K(-r) = -K(r); shape (*kernel_size, C_in, C_out)."""
    return 0.5 * (filters - filters.flip(tuple(range(filters.ndim - 2))))


class AntisymmetricConv(nn.Module):
    """A continuous convolution whose outputs sum to zero over all particles: whatever it moves, momentum is conserved.

    Filters are antisymmetric and messages sums f_j + f_i, so that the contributions of a pair to its two particles are
    opposite. Without bias.

    Source: Prantl et al., "Guaranteed Conservation of Momentum for Learning Particle-based Fluid Dynamics" (NeurIPS
    2022), section 3 (the authors store half a grid and mirror it along one axis; the filters are the same).

    Args:
        in_channels: C_in.
        out_channels: C_out.
        kernel_size: Cells of the filter grid, one number or one for each axis.
        dim: Number of space dimensions D.
        generator: Source of the initial weights; None for torch's global one.
    """

    def __init__(
        self,
        in_channels: int,
        out_channels: int,
        kernel_size: int | tuple[int, ...],
        dim: int,
        *,
        generator: torch.Generator | None = None,
    ):
        super().__init__()
        self.filters = uniform_filters(grid_shape(kernel_size, dim), in_channels, out_channels, generator)

    def forward(self, features: Float[Tensor, "N C_in"], geometry: ConvGeometry) -> Float[Tensor, "N C_out"]:
        """Features (N, C_in) to (N, C_out), summing to zero over the particles.

        Raises:
            ConfigError: If the geometry is normalised, which would weigh the two sides of a pair differently.
        """
        if geometry.normalize:
            raise ConfigError("`geometry` must not be normalised: 1/ψ differs between the two particles of a pair.")
        return continuous_conv(features, antisymmetric_filters(self.filters), geometry, message="sum")
