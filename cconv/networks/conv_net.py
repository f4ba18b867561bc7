"""ConvNet: continuous convolutions and fully connected layers in parallel (thesis figure 3.1).

Source: Ummenhofer et al., "Lagrangian Fluid Simulation with Continuous Convolutions" (ICLR 2020), section 4.
"""

from itertools import pairwise

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from cconv.errors import ConfigError, ShapeError, check_choice
from cconv.nn.continuous_conv import ContinuousConv, ConvGeometry

ACTIVATIONS = {"relu": F.relu, "gelu": F.gelu, "tanh": torch.tanh, "leaky_relu": F.leaky_relu}
SKIPS = ("before_activation", "after_activation", "none")


class ConvNet(nn.Module):
    """Particle network of the thesis, figure 3.1.

    Layer 0 concatenates boundary convolution, fluid convolution and fully connected layer, each of `layer_channels[0]`
    outputs. Every further layer k adds a convolution and a fully connected layer of the activated output before it;
    where the widths of z_k and z_{k-1} agree, z_{k-1} is added too. A network of one layer adds its branches instead
    of concatenating them. The last layer has no activation.

    With absolute messages every convolution and every fully connected layer has a bias, as published. With differences
    only one of two that are added has.

    Args:
        in_channels: Features of a fluid particle.
        layer_channels: Outputs of each layer, the last one the network's.
        kernel_size: Cells of the filter grid, one number or one for each axis.
        dim: Number of space dimensions D.
        boundary_channels: Features of a boundary point; 0 builds no boundary branch.
        activation: "relu", "gelu", "tanh" or "leaky_relu".
        message: "absolute" or "difference", of all fluid convolutions.
        skip: What a skip connection carries: z_{k-1} "before_activation" (the published code), "after_activation"
            (the thesis's code) or "none".
        initialization: "xavier_uniform" with zero biases; "open3d": convolutions uniform in ±0.05; "thesis": weights of
            fully connected layers zero, as the text of thesis section 4.1 says.
        own_channels: How many features, the last ones, layer 0's fully connected layer takes; None for all. Without any
            there is no such layer.
        bias: Whether there are biases; without them equal features give 0 by differences.
        generator: Source of the initial weights; None for torch's global one.

    Raises:
        ConfigError: If a name is unknown or there is no layer.
    """

    def __init__(
        self,
        in_channels: int,
        layer_channels: tuple[int, ...],
        kernel_size: int | tuple[int, ...],
        dim: int,
        *,
        boundary_channels: int = 0,
        activation: str = "relu",
        message: str = "absolute",
        skip: str = "before_activation",
        initialization: str = "xavier_uniform",
        own_channels: int | None = None,
        bias: bool = True,
        generator: torch.Generator | None = None,
    ):
        super().__init__()
        check_choice("activation", activation, ACTIVATIONS)
        check_choice("skip", skip, SKIPS)
        if not layer_channels:
            raise ConfigError("`layer_channels` must name at least one layer, got none.")
        self.activation, self.skip = activation, skip
        first, *rest = layer_channels
        self.own_channels = in_channels if own_channels is None else own_channels
        common = {"initialization": initialization, "generator": generator}
        of_branch = bias and (
            message == "absolute" or bool(rest)
        )  # branches of layer 0 are side by side if more follow
        of_added = bias and message == "absolute"
        self.boundary_conv = (
            ContinuousConv(boundary_channels, first, kernel_size, dim, bias=of_branch, **common)
            if boundary_channels
            else None
        )
        widths = [(1 + bool(boundary_channels) + bool(self.own_channels)) * first, *rest]
        self.convs = nn.ModuleList(
            ContinuousConv(inputs, outputs, kernel_size, dim, bias=has_bias, message=message, **common)
            for inputs, outputs, has_bias in [
                (in_channels, first, of_branch),
                *((*both, of_added) for both in pairwise(widths)),
            ]
        )
        of_first = [(self.own_channels, first)] if self.own_channels else []
        self.dense = nn.ModuleList(
            _linear(inputs, outputs, bias=bias, **common) for inputs, outputs in [*of_first, *pairwise(widths)]
        )

    @property
    def own_dense(self) -> nn.Linear | None:
        """Fully connected layer of layer 0, if there is one."""
        return self.dense[0] if self.own_channels else None

    def own(self, features: Tensor) -> Tensor:
        """What that layer takes of features (N, C_in)."""
        return features[:, features.shape[1] - self.own_channels :]

    def forward(
        self,
        features: Tensor,
        geometry: ConvGeometry,
        boundary_features: Tensor | None = None,
        boundary_geometry: ConvGeometry | None = None,
    ) -> Tensor:
        """Network output at the fluid particles.

        Args:
            features: Fluid features (N, C_in).
            geometry: Fluid particles seen from fluid particles.
            boundary_features: (B, C_boundary), only with a boundary branch.
            boundary_geometry: Boundary points seen from fluid particles, only with a boundary branch.

        Returns:
            (N, C_out).

        Raises:
            ShapeError: If boundary inputs are missing, or come without a boundary branch.
        """
        branches = [self.convs[0](features, geometry)]
        if self.own_dense is not None:
            branches.append(self.own_dense(self.own(features)))
        if (self.boundary_conv is None) != (boundary_features is None or boundary_geometry is None):
            raise ShapeError(
                "`boundary_features` and `boundary_geometry` must be given exactly when the network has a boundary "
                f"branch; it has {'none' if self.boundary_conv is None else 'one'}."
            )
        if self.boundary_conv is not None:
            branches.insert(0, self.boundary_conv(boundary_features, boundary_geometry))
        output = torch.cat(branches, dim=1) if len(self.convs) > 1 else sum(branches)
        for conv, dense in zip(self.convs[1:], self.dense[bool(self.own_channels) :], strict=True):
            output = self._layer(output, conv, dense, geometry)
        return output

    def _layer(self, previous: Tensor, conv: ContinuousConv, dense: nn.Linear, geometry: ConvGeometry) -> Tensor:
        activated = ACTIVATIONS[self.activation](previous)
        output = conv.convolve(activated, geometry) + dense(activated)
        if self.skip == "none" or output.shape != previous.shape:
            return output
        return output + (previous if self.skip == "before_activation" else activated)


def _linear(
    inputs: int, outputs: int, *, bias: bool, initialization: str, generator: torch.Generator | None
) -> nn.Linear:
    layer = nn.utils.skip_init(nn.Linear, inputs, outputs, bias=bias)
    if bias:
        nn.init.zeros_(layer.bias)
    if initialization == "thesis":
        nn.init.zeros_(layer.weight)
    else:
        nn.init.xavier_uniform_(layer.weight, generator=generator)
    return layer
