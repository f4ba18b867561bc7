"""RadialNet: radial convolutions and linear maps in parallel, equivariant to rotations and reflections as a whole."""

from collections.abc import Sequence
from functools import partial
from typing import Literal

import torch
from jaxtyping import Float
from pydantic import Field, model_validator
from torch import Tensor, nn

from cconv.batching import means_of_windows
from cconv.errors import ConfigError, check_choice
from cconv.neighbors import Edges
from cconv.networks.counting import (
    ARRAY,
    FLOAT,
    INDEX,
    CountedConv,
    CountedCost,
    Pairs,
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
from cconv.nn.kinds import Kinds, join_kinds, split_kinds
from cconv.nn.layers import Layers
from cconv.nn.radial_conv import RadialConv, RadialGeometry
from cconv.ops.radial import MOST_READS, num_reads
from cconv.validation import Flag, Whole


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
        in_channels: Kinds,
        out_channels: Kinds,
        dim: int,
        bias: bool = True,
        generator: torch.Generator | None = None,
    ):
        super().__init__()
        self.in_channels, self.dim = in_channels, dim
        self.scalar_weights = nn.Parameter(torch.zeros(in_channels.scalars, out_channels.scalars))
        self.vector_weights = nn.Parameter(torch.zeros(in_channels.vectors, out_channels.vectors))
        self.bias = nn.Parameter(torch.zeros(out_channels[0])) if bias else None
        for weights in (self.scalar_weights, self.vector_weights):
            if weights.numel():
                nn.init.xavier_uniform_(weights, generator=generator)

    def forward(self, values: Float[Tensor, "N C_in"]) -> Float[Tensor, "N C_out"]:
        """Values (N, S_in + V_in · D) to (N, S_out + V_out · D)."""
        scalars, vectors = split_kinds(values, self.in_channels, self.dim)
        mapped = torch.einsum("nvd,vw->nwd", vectors, self.vector_weights)
        linear = scalars @ self.scalar_weights
        return join_kinds(linear if self.bias is None else linear + self.bias, mapped)


class RadialNet(ConvolutionNetwork[RadialGeometry, RadialConv]):
    """Network of scalars and vectors.

    Every layer adds a radial convolution and a linear map of its input; the first layer also adds a convolution of
    the walls. If two layers have the same width, the output of the earlier one is added as well. Between layers the
    scalars pass the activation, and each vector is multiplied with the sigmoid of a scalar that its layer computes.

    Args:
        channels: Scalars and vectors of a fluid particle, of a wall point and of each layer.
        num_terms: Number of radial terms B.
        dim: Number of space dimensions D.
        activation: "relu", "gelu", "tanh" or "leaky_relu", of scalars.
        message: Name in `cconv.nn.radial_conv.MESSAGES`, of all fluid convolutions.
        conserves_momentum: Whether predicted vectors have the sum 0 over all particles of each window. The last layer
            then has "opposite" messages, which pairs of particles give to each other with opposite signs, and its
            linear map takes differences from the mean over these particles.
        residual: Whether outputs of layers of equal width are added up.
        generator: Source of the initial weights; None for torch's global one.

    Raises:
        ConfigError: If a name is unknown.
    """

    def __init__(
        self,
        channels: Channels[Kinds],
        num_terms: int,
        dim: int,
        *,
        activation: str = "relu",
        message: str = "absolute",
        conserves_momentum: bool = False,
        residual: bool = True,
        generator: torch.Generator | None = None,
    ):
        super().__init__()
        check_choice("activation", activation, ACTIVATIONS)
        self.activation, self.residual, self.dim = activation, residual, dim
        self.conserves_momentum = conserves_momentum
        *hidden, last = channels.layers
        self.hidden_channels, self.own_channels = hidden, channels.mapped
        inputs = [channels.inputs, *hidden]
        outputs = [*(Kinds(scalars + vectors, vectors) for scalars, vectors in hidden), last]  # a gate for each vector
        conv_of = partial(RadialConv, num_terms=num_terms, dim=dim, bias=False, generator=generator)
        self.boundary_conv = None if channels.walls is None else conv_of(channels.walls, outputs[0])
        messages = [*[message] * len(hidden), "opposite" if conserves_momentum else message]
        self.convs = Layers(
            conv_of(before, after, message=sent) for before, after, sent in zip(inputs, outputs, messages, strict=True)
        )
        has_bias = message != "difference" or last.vectors > 0  # a scalar of equal features is 0 by differences
        mapped = zip([self.own_channels, *hidden], outputs, strict=True)
        self.dense = Layers(
            VectorLinear(before, after, dim, has_bias, generator) for before, after in mapped if any(before)
        )

    @property
    def own_dense(self) -> VectorLinear | None:
        """Linear map of the first layer, if there is one."""
        return self.dense[0] if any(self.own_channels) else None

    def own(self, features: Float[Tensor, "N C"], geometry: RadialGeometry) -> Float[Tensor, "N C_own"]:
        """Select the inputs of that map from features (N, S + V · D)."""
        own = self.own_channels
        scalars, vectors = split_kinds(features, self.convs[0].in_channels, self.dim)
        selected = join_kinds(scalars[:, scalars.shape[1] - own.scalars :], vectors[:, : own.vectors])
        return self._mapped_last(selected, geometry) if len(self.convs) == 1 else selected

    def _mapped_last(self, values: Float[Tensor, "N C"], geometry: RadialGeometry) -> Float[Tensor, "N C"]:
        """Inputs of the linear map of the last layer, whose outputs add up to 0 in a window that conserves momentum."""
        return values - means_of_windows(values, geometry.batch_index) if self.conserves_momentum else values

    def forward(
        self,
        features: Float[Tensor, "N C_in"],
        geometry: RadialGeometry,
        walls: WallInputs[RadialGeometry] | None = None,
    ) -> Float[Tensor, "N C_out"]:
        """Scalars and vectors of the last layer, (N, S + V · D), of such values of its inputs; see `Network`."""
        output = self.convs[0](features, geometry)
        if self.own_dense is not None:
            output = output + self.own_dense(self.own(features, geometry))
        for conv, seen in with_inputs(self.boundary_conv, walls):
            output = output + conv(seen.features, seen.geometry)
        following_dense = self.dense[any(self.own_channels) :]
        for channels, conv, dense in zip(self.hidden_channels, self.convs[1:], following_dense, strict=True):
            activated = self._activate(output, channels)
            mapped = self._mapped_last(activated, geometry) if conv is self.convs[-1] else activated
            following = conv.convolve(activated, geometry) + dense(mapped)
            output = following + output if self.residual and following.shape == output.shape else following
        return output

    def _activate(self, values: Tensor, channels: Kinds) -> Tensor:
        scalars, vectors = split_kinds(values, Kinds(sum(channels), channels.vectors), self.dim)
        passed, gates = scalars.split(channels, dim=1)
        return join_kinds(ACTIVATIONS[self.activation](passed), torch.sigmoid(gates)[:, :, None] * vectors)

    def linear_terms(self) -> "RadialTerms":
        """The network of a single layer as a linear map of its coefficients."""
        check_single_layer(len(self.convs))
        return RadialTerms(self)


class RadialTerms(LinearTerms[RadialGeometry]):
    """The single layer of a `RadialNet` as a linear map of its coefficients: scalars apart from vectors."""

    def __init__(self, network: RadialNet):
        self.network = network

    def terms(
        self, features: Float[Tensor, "N C"], geometry: RadialGeometry, walls: WallInputs[RadialGeometry] | None = None
    ) -> list[Float[Tensor, "R P"]]:
        """Terms of the scalars (N, P) and of the components of the vectors (N · D, P'), where there are any."""
        boundary = with_inputs(self.network.boundary_conv, walls)
        gathered = [conv.columns(seen.features, seen.geometry) for conv, seen in boundary]
        gathered.append(self.network.convs[0].columns(features, geometry))
        own = self.network.own(features, geometry)
        scalars, vectors = split_kinds(own, self.network.own_channels, self.network.dim)
        of_scalars = [*(to_scalars for to_scalars, _ in gathered), scalars]
        if self.network.own_dense is not None and self.network.own_dense.bias is not None:
            of_scalars.append(torch.ones_like(features[:, :1]))
        of_vectors = [*(to_vectors for _, to_vectors in gathered), vectors.transpose(1, 2).flatten(0, 1)]
        terms = [torch.cat(of_scalars, dim=1), torch.cat(of_vectors, dim=1)]
        return [values for values, count in zip(terms, self._out_channels, strict=True) if count]

    def targets(self, target: Float[Tensor, "N C_out"]) -> list[Float[Tensor, "R C"]]:
        """Targets (N, S) and (N · D, V) of each set of terms."""
        scalars, vectors = split_kinds(target, self._out_channels, self.network.dim)
        targets = [scalars, vectors.transpose(1, 2).flatten(0, 1)]
        return [values for values, count in zip(targets, self._out_channels, strict=True) if count]

    @torch.no_grad()
    def assign(self, coefficients: Sequence[Float[Tensor, "P C"]]) -> None:
        """Make coefficients (P, S) and (P', V) those of the network."""
        network, dense = self.network, self.network.own_dense
        convs = [conv for conv in (network.boundary_conv, network.convs[0]) if conv is not None]
        of_scalars: list[Tensor] = [conv.scalar_filters for conv in convs]
        of_vectors: list[Tensor] = [conv.vector_filters for conv in convs]
        if dense is not None:
            of_scalars += [dense.scalar_weights, *([] if dense.bias is None else [dense.bias[None]])]
            of_vectors += [dense.vector_weights]
        present = [kind for kind, count in zip((of_scalars, of_vectors), self._out_channels, strict=True) if count]
        for tensors, values in zip(present, coefficients, strict=True):
            assign_rows(tensors, values)

    @property
    def _out_channels(self) -> Kinds:
        return self.network.convs[0].out_channels


class RadialNetSettings(ConvolutionSettings):
    """Hyperparameters of a `RadialNet`; the channels of a hidden layer are its number of scalars and of vectors."""

    is_equivariant = True
    basis_size = "radial_terms"
    linear_settings = (*ConvolutionSettings.linear_settings, basis_size, "conserves_momentum")

    architecture: Literal["radial_net"] = "radial_net"
    radial_terms: Whole = Field(16, ge=1, le=512)
    conserves_momentum: Flag = False
    skip: Literal["before_activation", "none"] = "before_activation"

    @property
    def in_words(self) -> str:
        """Its layers and radial terms."""
        layers = "radial layer" if self.layers == 1 else f"{self.layers} radial layers"
        return f"{layers}, {self.radial_terms} terms"

    @model_validator(mode="after")
    def _pairs_weigh_each_other_alike(self) -> "RadialNetSettings":
        if self.conserves_momentum and self.normalize:
            raise ValueError("`conserves_momentum` needs `normalize = false`: ψ differs between the two of a pair")
        return self

    def build(
        self, inputs: Kinds, walls: Kinds | None, outputs: Kinds, dim: int, generator: torch.Generator | None = None
    ) -> RadialNet:
        """The network with fresh weights; arguments as of `NetworkSettings.build`."""
        if self.conserves_momentum and outputs.scalars:
            raise ConfigError("`network.conserves_momentum` must be false where a scalar is predicted.")
        layers = (*(Kinds(width, width) for width in self.hidden_widths), outputs)
        return RadialNet(
            Channels(self.sent(inputs), layers, walls=walls, own=self.own(inputs, outputs)),
            self.radial_terms,
            dim,
            activation=self.activation,
            message=self.message,
            conserves_momentum=self.conserves_momentum,
            residual=self.skip == "before_activation",
            generator=generator,
        )

    def arrange(self, features: Float[Tensor, "N C"], kinds: Kinds, dim: int) -> Float[Tensor, "N C_in"]:
        """Scalars, without the constant where differences are taken, then vectors."""
        return features[:, 1:] if self.takes_differences else features

    def geometry(self, edges: Edges) -> RadialGeometry:
        """Radial terms and direction of each pair."""
        return RadialGeometry(edges, self.radial_terms, window=self.window, normalize=self.normalize)

    def _counted_layers(
        self, inputs: Kinds, walls: Kinds | None, outputs: Kinds, dim: int, fluid: Pairs, boundary: Pairs
    ) -> tuple[list[CountedConv], list[tuple[Kinds, Kinds]]]:
        """Convolutions and linear maps; each vector of a hidden layer has a scalar for its gate."""
        hidden = [Kinds(width, width) for width in self.hidden_widths]
        before = [self.sent(inputs), *hidden]
        after = [*(Kinds(scalars + vectors, vectors) for scalars, vectors in hidden), outputs]
        mapped = zip([self.own(inputs, outputs), *hidden], after, strict=True)
        convs = [CountedConv(*kinds, fluid) for kinds in zip(before, after, strict=True)]
        if walls is not None:
            convs.append(CountedConv(walls, after[0], boundary))
        return convs, [kinds for kinds in mapped if any(kinds[0])]

    def own(self, inputs: Kinds, outputs: Kinds) -> Kinds:
        """Return the inputs of the first layer's linear map; see `ConvolutionSettings.own`.

        Where scalars are sent as they are and vectors as differences, the last vector, a velocity, is left out: the
        network then does not see at which velocity the whole scene moves.
        """
        own = super().own(inputs, outputs)
        return own if self.message in ("absolute", "difference") else Kinds(own.scalars, max(0, own.vectors - 1))

    def _count_conv(self, conv: CountedConv, dim: int) -> CountedCost:
        """Pairs read filters themselves where these are few; else messages are gathered into columns of terms.

        The bytes of both differ at `MOST_READS`, since what a pair reads of filters is counted and what it adds to
        columns is not.
        """
        (scalars, vectors), (to_scalars, to_vectors), neighbors = conv.inputs, conv.outputs, conv.pairs.neighbors
        reads = num_reads(conv.inputs, conv.outputs, dim)
        if reads <= MOST_READS:
            # Two values and a message of each read; projections, directions.
            of_pair, of_particle = 3 * reads + dim * vectors + dim * to_vectors, 0
            moved, kept = reads * FLOAT, 0
        else:
            of_scalars = (scalars + vectors) * (to_scalars > 0)
            of_vectors = dim * (scalars + 2 * vectors) * (to_vectors > 0)
            columns = of_scalars + of_vectors
            # Projections; messages at the two terms around a pair, in columns that stay in a core's cache, from which
            # the product with the filters reads them once.
            of_pair = dim * vectors + 2 * columns
            of_particle = self.radial_terms * (of_scalars * to_scalars + of_vectors * to_vectors)
            moved, kept = 0, self.radial_terms * columns * FLOAT
        moved += 2 * INDEX + (dim + 1 + conv.inputs.num_values(dim)) * FLOAT
        return CountedCost(
            flops_per_particle=2.0 * (neighbors * of_pair + of_particle),
            bytes_per_particle=neighbors * moved + kept + conv.outputs.num_values(dim) * ARRAY,
        )

    def _geometry_arrays(self, dim: int) -> int:
        """Arrays of all pairs: the window, where there is one."""
        weighted = self.window != "none" or self.normalize
        return window_arrays(self.window, self.normalize) if weighted else 0
