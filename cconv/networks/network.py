"""The base classes of networks: settings that build them, geometry, counted cost, and linear terms."""

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import ClassVar, Generic, Literal, NoReturn, TypeVar

import torch
from jaxtyping import Float
from pydantic import Field
from torch import Tensor, nn

from cconv.errors import ConfigError, ShapeError
from cconv.neighbors import Edges
from cconv.networks.counting import (
    CountedConv,
    CountedCost,
    NeighborDensity,
    Pairs,
    count_arrays,
    count_linear,
    count_search,
    total,
)
from cconv.nn.continuous_conv import ConvGeometry
from cconv.nn.kinds import Kinds
from cconv.nn.layers import Layers
from cconv.nn.message_passing import PairGeometry
from cconv.nn.radial_conv import RadialGeometry
from cconv.nn.steerable import SteerableGeometry
from cconv.validation import Flag, Real, StrictModel, Whole

Geometry = ConvGeometry | RadialGeometry | PairGeometry | SteerableGeometry
GeometryT = TypeVar("GeometryT", bound=Geometry)
Layer = TypeVar("Layer", bound=nn.Module)
Width = TypeVar("Width", int, Kinds)


@dataclass(frozen=True)
class Channels(Generic[Width]):
    """The widths of a network: numbers of features, or of scalars and vectors.

    Attributes:
        inputs: Input features of a fluid particle.
        layers: Outputs of each layer; the last are the outputs of the network.
        walls: Input features of a wall point; None builds no convolution of the walls.
        own: Number of inputs (the last scalars and the first vectors) of the first layer's linear map of a particle's
            own features; None for all. With 0 there is no such map.

    Raises:
        ConfigError: If there is no layer.
    """

    inputs: Width
    layers: tuple[Width, ...]
    walls: Width | None = None
    own: Width | None = None

    def __post_init__(self) -> None:
        if not self.layers:
            raise ConfigError("`layers` must name the outputs of at least one layer, got none.")

    @property
    def mapped(self) -> Width:
        """What the first layer's linear map takes."""
        return self.inputs if self.own is None else self.own


@dataclass(frozen=True)
class WallInputs(Generic[GeometryT]):
    """Inputs of a network from the walls.

    Attributes:
        features: Features of the wall points (B, C).
        geometry: Wall points seen from fluid particles.
    """

    features: Float[Tensor, "B C"]
    geometry: GeometryT


class LinearTerms(ABC, Generic[GeometryT]):
    """A network of a single layer as a linear function of its coefficients, for least squares."""

    @abstractmethod
    def terms(
        self, features: Float[Tensor, "N C"], geometry: GeometryT, walls: WallInputs[GeometryT] | None = None
    ) -> list[Float[Tensor, "R P"]]:
        """Sets of terms (R, P): an output is terms @ coefficients. Arguments as of `Network.forward`."""

    @abstractmethod
    def targets(self, target: Float[Tensor, "N C_out"]) -> list[Float[Tensor, "R C"]]:
        """Targets (R, C) of each set of terms, of a target (N, C) of the network."""

    @abstractmethod
    def assign(self, coefficients: Sequence[Float[Tensor, "P C"]]) -> None:
        """Make coefficients (P, C) of each set those of the network."""


def varying(inputs: Kinds) -> Kinds:
    """Return the inputs without the constant, the first scalar, for networks with biases in its place."""
    return Kinds(inputs.scalars - 1, inputs.vectors)


def refuse_linear_terms(architecture: str) -> NoReturn:
    """Refuse the closed form of a network that is linear in its coefficients in no setting.

    Raises:
        ConfigError: Always.
    """
    raise ConfigError(f"`network.architecture` {architecture!r} has no closed form; train it.")


def assign_rows(weights: Sequence[Tensor], values: Float[Tensor, "P C"]) -> None:
    """Copy rows of `values` (P, C) to weights whose last axis is C, in order."""
    rows = values.split([weight.numel() // values.shape[1] for weight in weights])
    for weight, part in zip(weights, rows, strict=True):
        weight.copy_(part.reshape(weight.shape))


class Network(nn.Module, ABC, Generic[GeometryT]):
    """A map from features of fluid particles and walls to outputs at the fluid particles."""

    @abstractmethod
    def forward(
        self, features: Float[Tensor, "N C_in"], geometry: GeometryT, walls: WallInputs[GeometryT] | None = None
    ) -> Float[Tensor, "N C_out"]:
        """Outputs at the fluid particles.

        Args:
            features: Features of fluid particles, as `NetworkSettings.arrange` gives them.
            geometry: Fluid particles seen from fluid particles.
            walls: Wall points, only if the network has a convolution of the walls.

        Returns:
            Scalars and vectors of the last layer, (N, S + V · D).

        Raises:
            ShapeError: If wall inputs are missing, or given to a network without a convolution of the walls.
        """

    @abstractmethod
    def linear_terms(self) -> LinearTerms[GeometryT]:
        """Return the network as a linear function of its coefficients.

        Raises:
            ConfigError: If it has several layers.
        """


def with_inputs(conv: Layer | None, walls: WallInputs[GeometryT] | None) -> list[tuple[Layer, WallInputs[GeometryT]]]:
    """Pair the convolution of the walls, if the network has one, with its inputs.

    Raises:
        ShapeError: If only one of the two is given.
    """
    if conv is None and walls is None:
        return []
    if conv is None or walls is None:
        raise ShapeError(
            "`walls` must be given exactly when the network has a convolution of the walls; it has "
            f"{'none' if conv is None else 'one'}."
        )
    return [(conv, walls)]


class ConvolutionNetwork(Network[GeometryT], Generic[GeometryT, Layer]):
    """A network of stacked convolutions.

    Attributes:
        convs: Convolution of the fluid in each layer.
    """

    convs: Layers[Layer]


def check_single_layer(layers: int) -> None:
    """Check that a network is linear in its coefficients.

    Raises:
        ConfigError: If it has several layers.
    """
    if layers != 1:
        raise ConfigError(f"`network.layers` must be 1 for a closed form, got {layers}; train the others.")


class NetworkSettings(StrictModel, ABC):
    """Hyperparameters of a network of some architecture, as study files and checkpoints hold them.

    `relative_cutoff` is the largest distance of neighbours, in particle spacings.
    """

    is_equivariant: ClassVar[bool] = False  # to rotations and reflections, whatever its weights
    linear_with: ClassVar[Mapping[str, int]] = {}  # settings that make it linear in its coefficients, where some do
    linear_settings: ClassVar[tuple[str, ...]] = ()  # further settings that matter then
    basis_size: ClassVar[str]  # the one of them that says how many basis functions a filter has
    includes_self: ClassVar[bool] = False  # whether a fluid particle is its own neighbour

    architecture: str
    relative_cutoff: Real = Field(2.25, ge=1e-3, le=10)

    @property
    def in_words(self) -> str:
        """What the network is, for a reader, e.g. "radial layer, 8 terms"."""
        return self.architecture.replace("_", " ")

    @abstractmethod
    def build(
        self, inputs: Kinds, walls: Kinds | None, outputs: Kinds, dim: int, generator: torch.Generator | None = None
    ) -> Network:
        """The network with fresh weights.

        Args:
            inputs: Input features of a fluid particle; the first scalar is a constant.
            walls: Input features of a wall point; None builds no convolution of the walls.
            outputs: Predicted scalars and vectors.
            dim: Number of space dimensions D.
            generator: Source of the initial weights; None for torch's global one.
        """

    @abstractmethod
    def arrange(self, features: Float[Tensor, "N C"], kinds: Kinds, dim: int) -> Float[Tensor, "N C_in"]:
        """Features (N, S + V · D), scalars first and a constant first of all, as the network takes them."""

    @abstractmethod
    def geometry(self, edges: Edges) -> Geometry:
        """Compute the geometry of pairs of particles, once for all layers."""

    @abstractmethod
    def has_intercept(self, outputs: Kinds) -> bool:
        """Tell whether the output has a constant part, so that the target's mean may be subtracted."""

    @abstractmethod
    def count(
        self, inputs: Kinds, walls: Kinds | None, outputs: Kinds, dim: int, around: NeighborDensity
    ) -> CountedCost:
        """Count the cost of a prediction per particle from its features; arguments as of `build`, and point density."""


class GraphSettings(NetworkSettings):
    """The common settings of graph networks, which pass messages between encoder and decoder.

    `layers` is the number of steps of message passing; a particle is its own neighbour, as in LagrangeBench.
    """

    includes_self = True

    relative_cutoff: Real = Field(1.45, ge=1e-3, le=10)
    layers: Whole = Field(10, ge=1, le=64)

    def arrange(self, features: Float[Tensor, "N C"], kinds: Kinds, dim: int) -> Float[Tensor, "N C_in"]:
        """Scalars without the constant, which biases replace, then vectors."""
        return features[:, 1:]

    def has_intercept(self, outputs: Kinds) -> bool:
        """There are biases, of scalars at least."""
        return True


class ConvolutionSettings(NetworkSettings):
    """The common settings of networks of stacked convolutions.

    The layers have `first_channels`, then `hidden_channels`, and the components of the target.
    """

    linear_with = {"layers": 1}
    linear_settings: ClassVar[tuple[str, ...]] = ("relative_cutoff", "window", "normalize", "message")

    layers: Whole = Field(4, ge=1, le=16)
    first_channels: Whole = Field(32, ge=1, le=4096)
    hidden_channels: Whole = Field(64, ge=1, le=4096)
    window: Literal["none", "poly6", "gaussian", "cubic_spline"] = "poly6"
    normalize: Flag = False
    message: Literal["absolute", "difference", "mixed", "opposite"] = "absolute"
    activation: Literal["relu", "gelu", "tanh", "leaky_relu"] = "relu"

    @property
    def hidden_widths(self) -> list[int]:
        """Outputs of each layer but the last."""
        return [self.first_channels, *[self.hidden_channels] * (self.layers - 2)] if self.layers > 1 else []

    @property
    def takes_differences(self) -> bool:
        """Whether fluid convolutions take differences of features, to which a constant adds nothing."""
        return self.message == "difference"

    def has_intercept(self, outputs: Kinds) -> bool:
        """Whether there are biases and a shift of the target.

        A scalar from differences has none, so that it is 0 where nothing differs.
        """
        return not self.takes_differences or outputs.vectors > 0

    def count(
        self, inputs: Kinds, walls: Kinds | None, outputs: Kinds, dim: int, around: NeighborDensity
    ) -> CountedCost:
        """Cost of one particle's prediction: of convolutions, geometry, neighbour search and linear maps."""
        fluid, boundary = around.pairs(self.relative_cutoff, dim)
        searched = [fluid] if walls is None else [fluid, boundary]
        convs, maps = self._counted_layers(inputs, walls, outputs, dim, fluid, boundary)
        return total(
            [
                *(self._count_conv(conv, dim) for conv in convs),
                *(count_arrays(self._geometry_arrays(dim), pairs) for pairs in searched),
                *(count_search(pairs, dim) for pairs in searched),
                *(count_linear(before, after, dim) for before, after in maps),
            ]
        )

    @abstractmethod
    def _counted_layers(
        self, inputs: Kinds, walls: Kinds | None, outputs: Kinds, dim: int, fluid: Pairs, boundary: Pairs
    ) -> tuple[list[CountedConv], list[tuple[Kinds, Kinds]]]:
        """Convolutions and linear maps of all layers."""

    @abstractmethod
    def _count_conv(self, conv: CountedConv, dim: int) -> CountedCost:
        """Cost of a convolution."""

    @abstractmethod
    def _geometry_arrays(self, dim: int) -> int:
        """How many arrays of all pairs the geometry takes."""

    def sent(self, inputs: Kinds) -> Kinds:
        """Return the features that particles send to each other; the constant is left out if they send differences."""
        return Kinds(inputs.scalars - self.takes_differences, inputs.vectors)

    def own(self, inputs: Kinds, outputs: Kinds) -> Kinds:
        """Return the inputs of the first layer's linear map of a particle's own features, the constant left out.

        A scalar from differences does not depend on them. A vector may have scalars of the particle as factors, as the
        density is a factor of a density gradient.
        """
        if not self.takes_differences:
            return Kinds(inputs.scalars - 1, inputs.vectors)
        return Kinds(inputs.scalars - 1 if outputs.vectors else 0, 0)
