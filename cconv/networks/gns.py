"""GNS: an encoder, message passing and a decoder, the graph network that LagrangeBench compares with.

Source: Sanchez-Gonzalez et al., "Learning to Simulate Complex Physics with Graph Networks" (ICML 2020), section 3.2;
sizes of LagrangeBench (Toshev et al., NeurIPS 2023), `lagrangebench/models/gns.py`.
"""

from collections.abc import Sequence
from typing import Literal

import torch
from jaxtyping import Float
from pydantic import Field
from torch import Tensor, nn

from cconv.errors import check_choice
from cconv.neighbors import Edges
from cconv.networks.counting import CountedCost, NeighborDensity, count_arrays, count_linear, count_search, total
from cconv.networks.network import (
    Channels,
    GraphSettings,
    LinearTerms,
    Network,
    WallInputs,
    refuse_linear_terms,
    varying,
    with_inputs,
)
from cconv.nn.activations import ACTIVATIONS
from cconv.nn.kinds import Kinds, split_kinds
from cconv.nn.layers import Layers
from cconv.nn.message_passing import MLP, MessagePassing, PairGeometry, segment_sums
from cconv.validation import Whole


class GNS(Network[PairGeometry]):
    """Graph network of encoder, message passing and decoder.

    The scalars of a particle pass a learned matrix; of a type that is told by ones and zeros this is the published
    embedding. They, and the components of the vectors, are encoded to latent values, as are displacement and distance
    of each pair. Boundary points, which the published network does not know, send one message each to the particles
    near them, which is added to the encoded particles.

    Args:
        channels: Scalars and vectors of a fluid particle, of a wall point, and of the output, as its only layer.
        dim: Number of space dimensions D.
        layers: Steps of message passing.
        widths: Widths of the hidden layers of each multilayer perceptron, then that of the latent values.
        embedding: Width of the embedded scalars.
        activation: "relu", "gelu", "tanh" or "leaky_relu".
        generator: Source of the initial weights; None for torch's global one.

    Raises:
        ConfigError: If the activation is unknown.
    """

    def __init__(
        self,
        channels: Channels[Kinds],
        dim: int,
        *,
        layers: int = 10,
        widths: Sequence[int] = (128, 128),
        embedding: int = 16,
        activation: str = "relu",
        generator: torch.Generator | None = None,
    ):
        super().__init__()
        check_choice("activation", activation, ACTIVATIONS)
        self.inputs, self.dim = channels.inputs, dim
        scalars, vectors = channels.inputs
        *hidden, width = widths
        self.embedding = _embedding(scalars, embedding, generator) if scalars else None
        known = embedding * bool(scalars) + vectors * dim
        self.particle_encoder = MLP([known], hidden, width, activation=activation, generator=generator)
        self.pair_encoder = MLP([dim + 1], hidden, width, activation=activation, generator=generator)
        self.wall_encoder = None
        if channels.walls is not None:
            parts = [dim + 1, channels.walls.num_values(dim)]
            self.wall_encoder = MLP(parts, hidden, width, activation=activation, generator=generator)
        self.steps = Layers(MessagePassing(width, hidden, activation, generator) for _ in range(layers))
        outputs = channels.layers[-1].num_values(dim)
        self.decoder = MLP([width], hidden, outputs, activation=activation, norm=False, generator=generator)

    def forward(
        self, features: Float[Tensor, "N C_in"], geometry: PairGeometry, walls: WallInputs[PairGeometry] | None = None
    ) -> Float[Tensor, "N C_out"]:
        """Outputs (N, C_out) at the fluid particles; arguments as of `Network.forward`."""
        particles = self.particle_encoder(self._known(features))
        for encoder, seen in with_inputs(self.wall_encoder, walls):
            messages = encoder(seen.geometry.features, (seen.features, seen.geometry.edges.senders))
            particles = particles + segment_sums(messages, seen.geometry.edges.row_splits)
        pairs = self.pair_encoder(geometry.features)
        for step in self.steps:
            particles, pairs = step(particles, pairs, geometry.edges)
        return self.decoder(particles)

    def _known(self, features: Tensor) -> Tensor:
        """Embedded scalars, and the components of the vectors."""
        if self.embedding is None:
            return features
        scalars, vectors = split_kinds(features, self.inputs, self.dim)
        return torch.cat([scalars @ self.embedding, vectors.flatten(1)], dim=1)

    def linear_terms(self) -> LinearTerms[PairGeometry]:
        """Refuse: it is not linear in its coefficients."""
        refuse_linear_terms("gns")


def _embedding(inputs: int, outputs: int, generator: torch.Generator | None) -> nn.Parameter:
    weights = nn.Parameter(torch.empty(inputs, outputs))
    nn.init.trunc_normal_(weights, generator=generator)
    return weights


class GNSSettings(GraphSettings):
    """Hyperparameters of a `GNS`; the defaults are those of the published GNS-10-128.

    `hidden_channels` is the width of latent values and hidden layers, `mlp_layers` the number of hidden layers of each
    multilayer perceptron, `embedding` the width of the embedded scalars.
    """

    architecture: Literal["gns"] = "gns"
    hidden_channels: Whole = Field(128, ge=1, le=4096)
    mlp_layers: Whole = Field(1, ge=1, le=8)
    embedding: Whole = Field(16, ge=1, le=1024)
    activation: Literal["relu", "gelu", "tanh", "leaky_relu"] = "relu"

    @property
    def in_words(self) -> str:
        """Its steps and width, as the published GNS-10-128 is named."""
        return f"GNS of {self.layers} steps, {self.hidden_channels} wide"

    def build(
        self, inputs: Kinds, walls: Kinds | None, outputs: Kinds, dim: int, generator: torch.Generator | None = None
    ) -> GNS:
        """The network with fresh weights; arguments as of `NetworkSettings.build`."""
        return GNS(
            Channels(varying(inputs), (outputs,), walls=walls),
            dim,
            layers=self.layers,
            widths=(self.hidden_channels,) * (self.mlp_layers + 1),
            embedding=self.embedding,
            activation=self.activation,
            generator=generator,
        )

    def geometry(self, edges: Edges) -> PairGeometry:
        """Relative displacement and distance of each pair."""
        return PairGeometry(edges)

    def count(
        self, inputs: Kinds, walls: Kinds | None, outputs: Kinds, dim: int, around: NeighborDensity
    ) -> CountedCost:
        """Cost of one particle's prediction: linear maps of particles and pairs, geometry, neighbour search."""
        fluid, boundary = around.pairs(self.relative_cutoff, dim)
        pairs, (scalars, vectors), width = fluid.neighbors + 1, varying(inputs), self.hidden_channels
        known = self.embedding * bool(scalars) + vectors * dim
        latent = _map(width, width)
        counted = [
            _map(scalars, self.embedding) if scalars else CountedCost(),
            self._perceptron(_map(known, width)),
            self._perceptron(_map(dim + 1, width)) * pairs,
            (self._perceptron(latent) * pairs + latent * 2 + self._perceptron(latent * 2)) * self.layers,
            self._perceptron(latent, outputs.num_values(dim)),
            count_arrays(2 * dim + 2, fluid),
            count_search(fluid, dim),
        ]
        if walls is not None:
            of_points = _map(walls.num_values(dim), width) * boundary.senders
            counted += [of_points, self._perceptron(_map(dim + 1, width)) * boundary.neighbors]
            counted += [count_arrays(2 * dim + 2, boundary), count_search(boundary, dim)]
        return total(counted)

    def _perceptron(self, entry: CountedCost, outputs: int | None = None) -> CountedCost:
        """Cost of a row of a multilayer perceptron: its first linear map, and the others."""
        width = self.hidden_channels
        last = _map(width, width if outputs is None else outputs)
        return entry + _map(width, width) * (self.mlp_layers - 1) + last


def _map(inputs: int, outputs: int) -> CountedCost:
    """Cost of a linear map of a row of values."""
    return count_linear(Kinds(inputs, 0), Kinds(outputs, 0), 1)
