"""ConvNet: continuous convolutions and fully connected layers in parallel (thesis figure 3.1).

Source: Ummenhofer et al., "Lagrangian Fluid Simulation with Continuous Convolutions" (ICLR 2020), section 4.
"""

from collections.abc import Sequence
from functools import partial
from itertools import pairwise
from typing import Literal

import torch
from jaxtyping import Float
from pydantic import Field
from torch import Tensor, nn

from cconv.errors import check_choice
from cconv.neighbors import Edges
from cconv.networks.counting import (
    FLOAT,
    INDEX,
    CountedConv,
    CountedCost,
    Pairs,
    count_filters,
    window_arrays,
)
from cconv.networks.network import (
    Channels,
    ConvolutionNetwork,
    ConvolutionSettings,
    LinearTerms,
    WallInputs,
    assign_rows,
    check_single_layer,
    with_inputs,
)
from cconv.nn.activations import ACTIVATIONS
from cconv.nn.continuous_conv import MESSAGES, ContinuousConv, ConvGeometry
from cconv.nn.kinds import Kinds, split_kinds
from cconv.nn.layers import Layers
from cconv.ops.convolution import columns
from cconv.validation import Flag, Whole

SKIPS = ("before_activation", "after_activation", "none")


class ConvNet(ConvolutionNetwork[ConvGeometry, ContinuousConv]):
    """Particle network of the thesis, figure 3.1.

    Layer 0 concatenates boundary convolution, fluid convolution and fully connected layer, each of `channels.layers[0]`
    outputs. Every further layer k adds a convolution and a fully connected layer of the activated output before it;
    where the widths of z_k and z_{k-1} agree, z_{k-1} is added too. A network of one layer adds these parts instead
    of concatenating them. The last layer has no activation.

    With absolute messages every convolution and every fully connected layer has a bias, as published. With differences
    only one of two that are added has.

    Args:
        channels: Numbers of features of a fluid particle, a wall point and each layer; `own` counts the last inputs.
        kernel_size: Cells of the filter grid along each axis, (depth, height, width), in 2D (height, width).
        activation: "relu", "gelu", "tanh" or "leaky_relu".
        message: "absolute" or "difference", of all fluid convolutions.
        skip: What a skip connection carries: z_{k-1} "before_activation" (the published code), "after_activation"
            (the thesis's code) or "none".
        initialization: "xavier_uniform" with zero biases; "open3d": convolutions uniform in ±0.05; "thesis": weights of
            fully connected layers zero, as the text of thesis section 4.1 says.
        bias: Whether there are biases; without them equal features give 0 by differences.
        generator: Source of the initial weights; None for torch's global one.

    Raises:
        ConfigError: If a name is unknown.
    """

    def __init__(
        self,
        channels: Channels[int],
        kernel_size: tuple[int, ...],
        *,
        activation: str = "relu",
        message: str = "absolute",
        skip: str = "before_activation",
        initialization: str = "xavier_uniform",
        bias: bool = True,
        generator: torch.Generator | None = None,
    ):
        super().__init__()
        check_choice("activation", activation, ACTIVATIONS)
        check_choice("skip", skip, SKIPS)
        self.activation, self.skip, self.own_channels = activation, skip, channels.mapped
        first, *rest = channels.layers
        conv_of = partial(
            ContinuousConv,
            kernel_size=kernel_size,
            dim=len(kernel_size),
            initialization=initialization,
            generator=generator,
        )
        of_branch = bias and (message == "absolute" or bool(rest))  # they stand side by side if more layers follow
        of_added = bias and message == "absolute"
        self.boundary_conv = None if channels.walls is None else conv_of(channels.walls, first, bias=of_branch)
        widths = [(1 + (channels.walls is not None) + bool(self.own_channels)) * first, *rest]
        self.convs = Layers(
            conv_of(inputs, outputs, bias=has_bias, message=message)
            for inputs, outputs, has_bias in [
                (channels.inputs, first, of_branch),
                *((*both, of_added) for both in pairwise(widths)),
            ]
        )
        of_first = [(self.own_channels, first)] if self.own_channels else []
        self.dense = Layers(
            _linear(inputs, outputs, bias, initialization, generator)
            for inputs, outputs in [*of_first, *pairwise(widths)]
        )

    @property
    def own_dense(self) -> nn.Linear | None:
        """Fully connected layer of layer 0, if there is one."""
        return self.dense[0] if self.own_channels else None

    def own(self, features: Float[Tensor, "N C"]) -> Float[Tensor, "N C_own"]:
        """Select the inputs of that layer from features (N, C_in)."""
        return features[:, features.shape[1] - self.own_channels :]

    def forward(
        self, features: Float[Tensor, "N C_in"], geometry: ConvGeometry, walls: WallInputs[ConvGeometry] | None = None
    ) -> Float[Tensor, "N C_out"]:
        """Outputs (N, C_out) at the fluid particles, of features (N, C_in) and (B, C_wall); see `Network`."""
        branches = [conv(seen.features, seen.geometry) for conv, seen in with_inputs(self.boundary_conv, walls)]
        branches.append(self.convs[0](features, geometry))
        if self.own_dense is not None:
            branches.append(self.own_dense(self.own(features)))
        output = torch.cat(branches, dim=1) if len(self.convs) > 1 else sum(branches[1:], start=branches[0])
        for conv, dense in zip(self.convs[1:], self.dense[bool(self.own_channels) :], strict=True):
            output = self._layer(output, conv, dense, geometry)
        return output

    def _layer(self, previous: Tensor, conv: ContinuousConv, dense: nn.Linear, geometry: ConvGeometry) -> Tensor:
        activated = ACTIVATIONS[self.activation](previous)
        output = conv.convolve(activated, geometry) + dense(activated)
        if self.skip == "none" or output.shape != previous.shape:
            return output
        return output + (previous if self.skip == "before_activation" else activated)

    def linear_terms(self) -> "GridTerms":
        """Return the network of a single layer as a linear function of its coefficients."""
        check_single_layer(len(self.convs))
        return GridTerms(self)


def _linear(inputs: int, outputs: int, bias: bool, initialization: str, generator: torch.Generator | None) -> nn.Linear:
    layer = nn.utils.skip_init(nn.Linear, inputs, outputs, bias=bias)
    if bias:
        nn.init.zeros_(layer.bias)
    if initialization == "thesis":
        nn.init.zeros_(layer.weight)
    else:
        nn.init.xavier_uniform_(layer.weight, generator=generator)
    return layer


class GridTerms(LinearTerms[ConvGeometry]):
    """The single layer of a `ConvNet` as a linear function of its coefficients."""

    def __init__(self, network: ConvNet):
        self.network = network

    def terms(
        self, features: Float[Tensor, "N C"], geometry: ConvGeometry, walls: WallInputs[ConvGeometry] | None = None
    ) -> list[Float[Tensor, "R P"]]:
        """Terms (N, P): columns of the boundary and the fluid, a particle's own features, one; those that there are."""
        own = MESSAGES[self.network.convs[0].message]
        parts = [] if walls is None else [columns(walls.features, walls.geometry.reads)]
        parts += [columns(features, geometry.reads, own), self.network.own(features)]
        if self._bias is not None:
            parts.append(torch.ones_like(features[:, :1]))
        return [torch.cat(parts, dim=1)]

    def targets(self, target: Float[Tensor, "N C_out"]) -> list[Float[Tensor, "R C"]]:
        """Targets (N, C) of each set of terms."""
        return [target]

    @torch.no_grad()
    def assign(self, coefficients: Sequence[Float[Tensor, "P C"]]) -> None:
        """Make coefficients (P, C) those of the network."""
        (values,) = coefficients
        convs = [conv for conv in (self.network.boundary_conv, self.network.convs[0]) if conv is not None]
        weights: list[Tensor] = [conv.filters for conv in convs]
        if self.network.own_dense is not None:
            weights.append(self.network.own_dense.weight.T)
        for bias in (conv.bias for conv in convs if conv.bias is not None):
            bias.zero_()
        assign_rows([*weights, *([] if self._bias is None else [self._bias[None]])], values)

    @property
    def _bias(self) -> Tensor | None:
        """Return the bias that is fitted; other biases of convolutions stay 0."""
        dense = self.network.own_dense
        return None if dense is None else dense.bias


class ConvNetSettings(ConvolutionSettings):
    """Hyperparameters of a `ConvNet`.

    The defaults have the published layer sizes and filters: 692,902 parameters for 4 inputs and 3 outputs in a scene
    with normals. `relative_cutoff` is the filter radius R (published: diameter 0.225 = 1.5·6·0.025 at spacing 0.05, so
    R = 2.25 spacings). Initial weights are the thesis's, Xavier-uniform; "open3d" draws them as the published code did.
    Points at exactly the same place are neighbours of each other; with `coincident = "ignored"` they are not, as in the
    published code.
    """

    basis_size = "kernel_size"
    linear_settings = (*ConvolutionSettings.linear_settings, basis_size, "mapping", "interpolation", "align_corners")

    architecture: Literal["conv_net"] = "conv_net"
    message: Literal["absolute", "difference"] = "absolute"
    kernel_size: Whole = Field(4, ge=1, le=32)
    mapping: Literal["identity", "ball_to_cube_radial", "ball_to_cube_volume_preserving"] = (
        "ball_to_cube_volume_preserving"
    )
    interpolation: Literal["linear", "nearest_neighbor", "linear_border"] = "linear"
    align_corners: Flag = True
    skip: Literal["before_activation", "after_activation", "none"] = "before_activation"
    initialization: Literal["xavier_uniform", "open3d", "thesis"] = "xavier_uniform"
    coincident: Literal["neighbors", "ignored"] = "neighbors"

    @property
    def in_words(self) -> str:
        """Its layers and the cells of their filters along an axis."""
        layers = "convolution on a grid" if self.layers == 1 else f"{self.layers} convolutions on grids"
        return f"{layers}, {self.kernel_size} cells a side"

    def build(
        self, inputs: Kinds, walls: Kinds | None, outputs: Kinds, dim: int, generator: torch.Generator | None = None
    ) -> ConvNet:
        """The network with fresh weights; arguments as of `NetworkSettings.build`."""
        channels = Channels(
            self.sent(inputs).num_values(dim),
            (*self.hidden_widths, outputs.num_values(dim)),
            walls=None if walls is None else walls.num_values(dim),
            own=self.own(inputs, outputs).num_values(dim) if self.takes_differences else None,
        )
        return ConvNet(
            channels,
            (self.kernel_size,) * dim,
            activation=self.activation,
            message=self.message,
            skip=self.skip,
            initialization=self.initialization,
            bias=self.has_intercept(outputs),
            generator=generator,
        )

    def arrange(self, features: Float[Tensor, "N C"], kinds: Kinds, dim: int) -> Float[Tensor, "N C_in"]:
        """Features in the published order: the constant, unless differences are taken, vectors, further scalars."""
        scalars, vectors = split_kinds(features, kinds, dim)
        constant = [] if self.takes_differences else [scalars[:, :1]]
        return torch.cat([*constant, vectors.flatten(1), scalars[:, 1:]], dim=1)

    def geometry(self, edges: Edges) -> ConvGeometry:
        """Cells and weights of the filters that each pair reads."""
        return ConvGeometry(
            edges if self.coincident == "neighbors" else edges.apart(),
            self.kernel_size,
            mapping=self.mapping,
            window=self.window,
            interpolation=self.interpolation,
            align_corners=self.align_corners,
            normalize=self.normalize,
        )

    def _counted_layers(
        self, inputs: Kinds, walls: Kinds | None, outputs: Kinds, dim: int, fluid: Pairs, boundary: Pairs
    ) -> tuple[list[CountedConv], list[tuple[Kinds, Kinds]]]:
        """Convolutions and fully connected layers; a grid knows scalars alone."""
        first, *rest = [*self.hidden_widths, outputs.num_values(dim)]
        features = self.sent(inputs).num_values(dim)
        own = self.own(inputs, outputs).num_values(dim) if self.takes_differences else features
        widths = [(1 + (walls is not None) + bool(own)) * first, *rest]
        hidden = [(Kinds(before, 0), Kinds(after, 0)) for before, after in pairwise(widths)]
        dense = [*([(Kinds(own, 0), Kinds(first, 0))] if own else []), *hidden]
        convs = [CountedConv(*kinds, fluid) for kinds in [(Kinds(features, 0), Kinds(first, 0)), *hidden]]
        if walls is not None:
            convs.append(CountedConv(Kinds(walls.num_values(dim), 0), Kinds(first, 0), boundary))
        return convs, dense

    def _count_conv(self, conv: CountedConv, dim: int) -> CountedCost:
        corners = 1 if self.interpolation == "nearest_neighbor" else 2**dim
        pair = INDEX + (dim + 2) * FLOAT
        sizes = conv.inputs.scalars, conv.outputs.scalars, self.kernel_size**dim, corners
        return count_filters(*sizes, conv.pairs.senders, conv.pairs.neighbors, pair)

    def _geometry_arrays(self, dim: int) -> int:
        """Arrays of all pairs from displacements to cells, fractions and weights, as `nn.filters` makes them."""
        mapped = {
            "identity": 0,
            "ball_to_cube_radial": 4 * dim + 4,
            "ball_to_cube_volume_preserving": (0, 0, 20, 53)[dim],
        }[self.mapping]
        return 12 * dim + mapped + window_arrays(self.window, self.normalize)
