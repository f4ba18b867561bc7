"""RadialNet: radial convolutions and linear maps in parallel, equivariant to rotations and reflections as a whole."""

import torch
from torch import Tensor, nn

from cconv.errors import ConfigError, ShapeError, check_choice
from cconv.networks.conv_net import ACTIVATIONS
from cconv.nn.radial_conv import Channels, RadialConv, RadialGeometry, join_kinds, split_kinds


class VectorLinear(nn.Module):
    """Linear map of scalars to scalars and of vectors to vectors; scalars alone can have a bias, 0 at first.

    Args:
        in_channels: Scalars and vectors of the input (N, S + V · D).
        out_channels: Scalars and vectors of the output.
        dim: Number of space dimensions D.
        bias: Whether scalars have a bias.
        generator: Source of the initial weights (Xavier-uniform); None for torch's global one.
    """

    def __init__(
        self,
        in_channels: Channels,
        out_channels: Channels,
        dim: int,
        bias: bool = True,
        generator: torch.Generator | None = None,
    ):
        super().__init__()
        self.in_channels, self.dim = in_channels, dim
        self.scalar_weights = nn.Parameter(torch.zeros(in_channels[0], out_channels[0]))
        self.vector_weights = nn.Parameter(torch.zeros(in_channels[1], out_channels[1]))
        self.bias = nn.Parameter(torch.zeros(out_channels[0])) if bias else None
        for weights in (self.scalar_weights, self.vector_weights):
            if weights.numel():
                nn.init.xavier_uniform_(weights, generator=generator)

    def forward(self, values: Tensor) -> Tensor:
        """Values (N, S_in + V_in · D) to (N, S_out + V_out · D)."""
        scalars, vectors = split_kinds(values, self.in_channels, self.dim)
        mapped = torch.einsum("nvd,vw->nwd", vectors, self.vector_weights)
        linear = scalars @ self.scalar_weights
        return join_kinds(linear if self.bias is None else linear + self.bias, mapped)


class RadialNet(nn.Module):
    """Network of scalars and vectors.

    Every layer adds a radial convolution and a linear map of its input, the first one a convolution of the boundary
    too. Where the widths of two layers agree, the output of the one before is added as well. Between layers the scalars
    pass the activation, and each vector is multiplied with the sigmoid of a scalar that its layer computes for it.

    Args:
        in_channels: Scalars and vectors of a fluid particle.
        layer_channels: Scalars and vectors of each layer, the last one the network's outputs.
        num_terms: Number of radial terms B.
        dim: Number of space dimensions D.
        boundary_channels: Scalars and vectors of a boundary point; (0, 0) builds no boundary branch.
        activation: "relu", "gelu", "tanh" or "leaky_relu", of scalars.
        message: "absolute" or "difference", of all fluid convolutions.
        residual: Whether outputs of layers of equal width are added up.
        own_channels: How many scalars, the last ones, and vectors the first layer's linear map takes; None for all.
            Without any there is no such map.
        bias: Whether scalars have biases; without them equal features give 0 by differences.
        generator: Source of the initial weights; None for torch's global one.

    Raises:
        ConfigError: If a name is unknown or there is no layer.
    """

    def __init__(
        self,
        in_channels: Channels,
        layer_channels: tuple[Channels, ...],
        num_terms: int,
        dim: int,
        *,
        boundary_channels: Channels = (0, 0),
        activation: str = "relu",
        message: str = "absolute",
        residual: bool = True,
        own_channels: Channels | None = None,
        bias: bool = True,
        generator: torch.Generator | None = None,
    ):
        super().__init__()
        check_choice("activation", activation, ACTIVATIONS)
        if not layer_channels:
            raise ConfigError("`layer_channels` must name at least one layer, got none.")
        self.activation, self.residual, self.dim = activation, residual, dim
        *hidden, last = layer_channels
        self.hidden_channels = hidden
        self.own_channels = in_channels if own_channels is None else own_channels
        inputs = [in_channels, *hidden]
        outputs = [*((scalars + vectors, vectors) for scalars, vectors in hidden), last]  # a gate for each vector
        self.boundary_conv = (
            RadialConv(boundary_channels, outputs[0], num_terms, dim, bias=False, generator=generator)
            if any(boundary_channels)
            else None
        )
        self.convs = nn.ModuleList(
            RadialConv(before, after, num_terms, dim, bias=False, message=message, generator=generator)
            for before, after in zip(inputs, outputs, strict=True)
        )
        mapped = zip([self.own_channels, *hidden], outputs, strict=True)
        self.dense = nn.ModuleList(
            VectorLinear(before, after, dim, bias, generator) for before, after in mapped if any(before)
        )

    @property
    def own_dense(self) -> VectorLinear | None:
        """Linear map of the first layer, if there is one."""
        return self.dense[0] if any(self.own_channels) else None

    def own(self, features: Tensor) -> Tensor:
        """What that map takes of features (N, S + V · D)."""
        scalars, vectors = split_kinds(features, self.convs[0].in_channels, self.dim)
        return join_kinds(scalars[:, scalars.shape[1] - self.own_channels[0] :], vectors[:, : self.own_channels[1]])

    def forward(
        self,
        features: Tensor,
        geometry: RadialGeometry,
        boundary_features: Tensor | None = None,
        boundary_geometry: RadialGeometry | None = None,
    ) -> Tensor:
        """Network output at the fluid particles.

        Args:
            features: Values of fluid particles (N, S + V · D).
            geometry: Fluid particles seen from fluid particles.
            boundary_features: Values of boundary points, only with a boundary branch.
            boundary_geometry: Boundary points seen from fluid particles, only with a boundary branch.

        Returns:
            Scalars and vectors of the last layer, (N, S + V · D).

        Raises:
            ShapeError: If boundary inputs are missing, or come without a boundary branch.
        """
        if (self.boundary_conv is None) != (boundary_features is None or boundary_geometry is None):
            raise ShapeError(
                "`boundary_features` and `boundary_geometry` must be given exactly when the network has a boundary "
                f"branch; it has {'none' if self.boundary_conv is None else 'one'}."
            )
        output = self.convs[0](features, geometry)
        if self.own_dense is not None:
            output = output + self.own_dense(self.own(features))
        if self.boundary_conv is not None:
            output = output + self.boundary_conv(boundary_features, boundary_geometry)
        following_dense = self.dense[any(self.own_channels) :]
        for channels, conv, dense in zip(self.hidden_channels, self.convs[1:], following_dense, strict=True):
            activated = self._activate(output, channels)
            following = conv.convolve(activated, geometry) + dense(activated)
            output = following + output if self.residual and following.shape == output.shape else following
        return output

    def _activate(self, values: Tensor, channels: Channels) -> Tensor:
        scalars, vectors = split_kinds(values, (sum(channels), channels[1]), self.dim)
        passed, gates = scalars.split(channels, dim=1)
        return join_kinds(ACTIVATIONS[self.activation](passed), torch.sigmoid(gates)[:, :, None] * vectors)
