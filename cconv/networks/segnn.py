"""SEGNN: message passing between scalars and vectors that is equivariant to rotations and reflections.

Source: Brandstetter et al., "Geometric and Physical Quantities Improve E(3) Equivariant Message Passing" (ICLR 2022);
sizes of LagrangeBench (Toshev et al., NeurIPS 2023), `lagrangebench/models/segnn.py`.
"""

from typing import Literal

import torch
from jaxtyping import Float
from pydantic import Field
from torch import Tensor

from cconv.neighbors import Edges
from cconv.networks.counting import ARRAY, CountedCost, NeighborDensity, count_arrays, count_search, total
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
from cconv.nn.kinds import Kinds, join_kinds, split_kinds
from cconv.nn.layers import Layers
from cconv.nn.steerable import (
    AXES,
    GatedBlock,
    Steerable,
    SteerableGeometry,
    SteerableMessagePassing,
    SteeredLinear,
    in_space,
    side_by_side,
    spherical_harmonics,
)
from cconv.validation import Whole


class SEGNN(Network[SteerableGeometry]):
    """Steerable graph network of degree 1.

    The attribute of a pair is the direction of its displacement, that of a particle the mean of its pairs' plus the
    direction of its velocity, the last of its vectors; the scalar of the latter is 1. Boundary points, which the
    published network does not know, send one message each to the particles near them, which is added to the embedded
    particles.

    Args:
        channels: Scalars and vectors of a fluid particle, of a wall point, and of the output, as its only layer.
        dim: Number of space dimensions D.
        layers: Steps of message passing.
        width: Number of scalars and of vectors between the layers.
        readout_layers: Gated blocks after the last step.
        generator: Source of the initial weights; None for torch's global one.

    Raises:
        ConfigError: If e3nn is not installed.
    """

    def __init__(
        self,
        channels: Channels[Kinds],
        dim: int,
        *,
        layers: int = 10,
        width: int = 32,
        readout_layers: int = 1,
        generator: torch.Generator | None = None,
    ):
        super().__init__()
        self.inputs, self.dim, latent = channels.inputs, dim, Kinds(width, width)
        self.wall_channels, self.harmonics = channels.walls, spherical_harmonics()
        self.embedding = SteeredLinear(self.inputs, latent, generator)
        self.wall_message = None
        if channels.walls is not None:
            seen = Kinds(channels.walls.scalars + 1, channels.walls.vectors + 1)
            self.wall_message = GatedBlock(seen, width, generator)
        self.steps = Layers(SteerableMessagePassing(width, generator) for _ in range(layers))
        self.readout = Layers(GatedBlock(latent, width, generator) for _ in range(readout_layers))
        self.output = SteeredLinear(latent, channels.layers[-1], generator)

    def forward(
        self,
        features: Float[Tensor, "N C_in"],
        geometry: SteerableGeometry,
        walls: WallInputs[SteerableGeometry] | None = None,
    ) -> Float[Tensor, "N C_out"]:
        """Scalars and vectors of the particles, (N, S + V · D); arguments as of `Network.forward`."""
        known = _steerable(features, self.inputs, self.dim)
        attributes = self._attributes(known, geometry)
        particles = self.embedding(known, attributes)
        for message, seen in with_inputs(self.wall_message, walls):
            particles = particles.plus(self._from_walls(message, seen))
        for step in self.steps:
            particles = step(particles, geometry, attributes)
        for block in self.readout:
            particles = block(particles, attributes)
        answers = self.output(particles, attributes)
        return join_kinds(answers.scalars, answers.vectors[:, : self.dim].transpose(1, 2))

    def _attributes(self, known: Steerable, geometry: SteerableGeometry) -> Float[Tensor, "N 4"]:
        """Attributes of the particles."""
        mean = geometry.mean_attributes
        if self.inputs.vectors:
            mean = mean + self.harmonics(known.vectors[:, :, -1])
        return torch.cat([torch.ones_like(mean[:, :1]), mean[:, 1:]], dim=1)

    def _from_walls(self, message: GatedBlock, walls: WallInputs[SteerableGeometry]) -> Steerable:
        """Sums of the messages of the wall points near each particle."""
        assert self.wall_channels is not None
        edges = walls.geometry.edges
        points = _steerable(walls.features, self.wall_channels, self.dim).rows(edges.senders)
        messages = message(side_by_side([points, walls.geometry.relative]), walls.geometry.attributes)
        return messages.summed(edges.row_splits)

    def linear_terms(self) -> LinearTerms[SteerableGeometry]:
        """Refuse: it is not linear in its coefficients."""
        refuse_linear_terms("segnn")


def _steerable(values: Tensor, kinds: Kinds, dim: int) -> Steerable:
    """Scalars and vectors of values (N, S + V · D)."""
    scalars, vectors = split_kinds(values, kinds, dim)
    return Steerable(scalars, in_space(vectors).transpose(1, 2))


class SEGNNSettings(GraphSettings):
    """Hyperparameters of a `SEGNN`; the defaults are those of the published SEGNN-10-64.

    `hidden_channels` is the number of scalars and of vectors (32 of each are the published 64 units), `readout_layers`
    the number of gated blocks after the last step: the published numbers of parameters are those of one, the published
    code builds two.
    """

    is_equivariant = True

    architecture: Literal["segnn"] = "segnn"
    hidden_channels: Whole = Field(32, ge=1, le=4096)
    readout_layers: Whole = Field(1, ge=0, le=8)

    @property
    def in_words(self) -> str:
        """Its steps and width; the published SEGNN-10-64 has 32 scalars and vectors."""
        return f"SEGNN of {self.layers} steps, {self.hidden_channels} scalars and vectors wide"

    def build(
        self, inputs: Kinds, walls: Kinds | None, outputs: Kinds, dim: int, generator: torch.Generator | None = None
    ) -> SEGNN:
        """The network with fresh weights; arguments as of `NetworkSettings.build`."""
        return SEGNN(
            Channels(varying(inputs), (outputs,), walls=walls),
            dim,
            layers=self.layers,
            width=self.hidden_channels,
            readout_layers=self.readout_layers,
            generator=generator,
        )

    def geometry(self, edges: Edges) -> SteerableGeometry:
        """Displacement, distance and attribute of each pair."""
        return SteerableGeometry(edges, spherical_harmonics())

    def count(
        self, inputs: Kinds, walls: Kinds | None, outputs: Kinds, dim: int, around: NeighborDensity
    ) -> CountedCost:
        """Cost of one particle's prediction: steered linear maps, geometry, neighbour search."""
        fluid, boundary = around.pairs(self.relative_cutoff, dim)
        width = self.hidden_channels
        latent, both = Kinds(width, width), Kinds(2 * width, 2 * width)
        gated, pair = Kinds(2 * width, width), Kinds(2 * width + 1, 2 * width + 1)
        message = _steered(pair, gated) + _steered(latent, gated)
        update = _steered(both, gated) + _steered(latent, latent)
        counted = [
            _steered(varying(inputs), latent),
            (message * (fluid.neighbors + 1) + update) * self.layers,
            _steered(latent, gated) * self.readout_layers,
            _steered(latent, outputs),
            count_arrays(12, fluid),
            count_search(fluid, dim),
        ]
        if walls is not None:
            seen = Kinds(walls.scalars + 1, walls.vectors + 1)
            counted += [_steered(seen, gated) * boundary.neighbors, count_search(boundary, dim)]
        return total(counted)


def _steered(inputs: Kinds, outputs: Kinds) -> CountedCost:
    """Cost of a steered linear map of a row: its matrix products, and the values before, between and after."""
    scalars, vectors = inputs
    products = (scalars + vectors) * outputs.scalars + (scalars + AXES * vectors) * outputs.vectors
    values = 3 * inputs.num_values(AXES) + 4 * outputs.num_values(AXES)
    return CountedCost(flops_per_particle=2.0 * products, bytes_per_particle=float(values * ARRAY))
