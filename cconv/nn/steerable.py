r"""Steerable layers of degree 1: linear maps of scalars and vectors whose weights turn with an attribute.

An attribute (a_0, a) is a scalar and a vector that say where something is. A steered linear map of scalars s and
vectors v is linear in their tensor product with it, as far as that has scalars and vectors:

.. math::
    \text{scalars:}\quad a_0 s, \; a \cdot v / \sqrt 3 \qquad\text{vectors:}\quad s\, a, \; a_0 v

Attributes are spherical harmonics, from e3nn (the optional extra `segnn`). In fewer than three dimensions the missing
components of vectors are 0 and stay so. Source: Brandstetter et al., "Geometric and Physical Quantities Improve E(3)
Equivariant Message Passing" (ICLR 2022); LagrangeBench (Toshev et al., NeurIPS 2023), `lagrangebench/models/segnn.py`.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from importlib import import_module

import torch
import torch.nn.functional as F
from jaxtyping import Float, Int
from torch import Tensor, nn

from cconv.errors import ConfigError
from cconv.neighbors import Edges, join_edges
from cconv.nn.kinds import Kinds
from cconv.nn.message_passing import segment_sums

AXES = 3  # of the vectors, whatever the dimension of the scene
SILU_GAIN, SIGMOID_GAIN = 1.6765, 1.8462  # with which activated normal values have the mean square 1


@dataclass(frozen=True)
class Steerable:
    """Scalars and vectors of particles or pairs, vectors with their components first.

    Attributes:
        scalars: (N, S).
        vectors: (N, 3, V).
    """

    scalars: Float[Tensor, "N S"]
    vectors: Float[Tensor, "N 3 V"]

    def rows(self, rows: Int[Tensor, " M"]) -> "Steerable":
        """Those of some rows."""
        return Steerable(self.scalars[rows], self.vectors[rows])

    def plus(self, other: "Steerable") -> "Steerable":
        """Sum of both."""
        return Steerable(self.scalars + other.scalars, self.vectors + other.vectors)

    def summed(self, row_splits: Int[Tensor, " splits"]) -> "Steerable":
        """Sums over the pairs of each receiver; arguments as of `segment_sums`."""
        vectors = segment_sums(self.vectors.flatten(1), row_splits)
        return Steerable(segment_sums(self.scalars, row_splits), vectors.unflatten(1, (AXES, -1)))


def side_by_side(parts: Sequence[Steerable]) -> Steerable:
    """Scalars of all parts, and vectors of all parts."""
    scalars, vectors = [part.scalars for part in parts], [part.vectors for part in parts]
    return Steerable(torch.cat(scalars, dim=1), torch.cat(vectors, dim=2))


def in_space(vectors: Float[Tensor, "*N D"]) -> Float[Tensor, "*N 3"]:
    """Vectors of D components with zeros for the missing ones."""
    return F.pad(vectors, (0, AXES - vectors.shape[-1]))


def spherical_harmonics() -> Callable[[Tensor], Tensor]:
    """Return the spherical harmonics of degrees 0 and 1 of the directions of vectors: (N, 3) to (N, 4).

    Y_0 = 0.282095 and Y_1 = 0.488603 x / |x|, whose square has the integral 1 over all directions; Y_1 of a zero vector
    is 0.

    Raises:
        ConfigError: If e3nn is not installed.
    """
    try:
        o3 = import_module("e3nn.o3")
    except ImportError as error:
        raise ConfigError(
            "`network.architecture` 'segnn' needs e3nn, which is not installed; run pip install 'cconv[segnn]'."
        ) from error
    return lambda vectors: o3.spherical_harmonics([0, 1], vectors, normalize=True, normalization="integral")


class SteerableGeometry:
    """Displacement, distance and attribute of each pair, and the mean attribute of the pairs of each receiver.

    Args:
        edges: Pairs of receivers i and senders j.
        harmonics: Spherical harmonics, see `spherical_harmonics`.

    Attributes:
        edges: As given.
        harmonics: As given.
        relative: Distance in cutoffs as a scalar, displacement x_i - x_j in cutoffs as a vector.
        attributes: Of each pair, (E, 4).
        mean_attributes: Of each receiver, (N, 4); 0 without a pair.

    Raises:
        ShapeError: If the edges do not fit together or hold values that are not finite.
    """

    def __init__(self, edges: Edges, harmonics: Callable[[Tensor], Tensor]):
        edges.check()
        self.edges, self.harmonics = edges, harmonics
        displacements = in_space(edges.displacements) / edges.cutoff
        self.relative = Steerable(edges.distances[:, None] / edges.cutoff, displacements[:, :, None])
        self.attributes = harmonics(displacements)
        counts = edges.row_splits.diff().clamp(min=1)[:, None]
        self.mean_attributes = segment_sums(self.attributes, edges.row_splits) / counts

    def joined_with(self, others: "Sequence[SteerableGeometry]") -> "SteerableGeometry":
        """The geometry of this window and of others in one graph."""
        return SteerableGeometry(join_edges([self.edges, *(other.edges for other in others)]), self.harmonics)

    @property
    def neighbor_counts(self) -> Int[Tensor, " N"]:
        """Number of neighbours of each receiver, itself not counted, (N,)."""
        return self.edges.neighbor_counts

    @property
    def nbytes(self) -> int:
        """Memory in bytes."""
        own = (self.relative.scalars, self.relative.vectors, self.attributes, self.mean_attributes)
        return self.edges.nbytes + sum(tensor.nbytes for tensor in own)


class SteeredLinear(nn.Module):
    """A linear map that an attribute steers; equations in the module's docstring.

    Weights are uniform in ±1/√fan_in, where the fan counts the terms of an output; scalars have a bias, 0 at first.

    Args:
        inputs: Scalars and vectors of the input.
        outputs: Scalars and vectors of the output.
        generator: Source of the initial weights; None for torch's global one.
    """

    def __init__(self, inputs: Kinds, outputs: Kinds, generator: torch.Generator | None = None):
        super().__init__()
        self.inputs = inputs
        self.scalar_weights = nn.Parameter(torch.empty(sum(inputs), outputs.scalars))
        self.vector_weights = nn.Parameter(torch.empty(sum(inputs), outputs.vectors))
        self.bias = nn.Parameter(torch.zeros(outputs.scalars))
        bound = max(sum(inputs), 1) ** -0.5
        for weights in (self.scalar_weights, self.vector_weights):
            nn.init.uniform_(weights, -bound, bound, generator=generator)

    def forward(self, values: Steerable, attributes: Float[Tensor, "N 4"]) -> Steerable:
        """Scalars and vectors of each row, steered by its attribute."""
        scalars, vectors = values.scalars, values.vectors
        alone, direction = attributes[:, :1], attributes[:, 1:, None]
        along = (vectors * direction).sum(dim=1) / math.sqrt(AXES)
        of_scalars, of_vectors = self.vector_weights.split(self.inputs)
        return Steerable(
            torch.cat([alone * scalars, along], dim=1) @ self.scalar_weights + self.bias,
            direction * (scalars @ of_scalars)[:, None] + alone[:, :, None] * (vectors @ of_vectors),
        )


class GatedBlock(nn.Module):
    """A steered linear map and an activation: half of its scalars pass a SiLU, the others gate the vectors.

    Args:
        inputs: Scalars and vectors of the input.
        width: Number of scalars and of vectors of the output.
        generator: Source of the initial weights; None for torch's global one.
    """

    def __init__(self, inputs: Kinds, width: int, generator: torch.Generator | None = None):
        super().__init__()
        self.steered = SteeredLinear(inputs, Kinds(2 * width, width), generator)

    def forward(self, values: Steerable, attributes: Float[Tensor, "N 4"]) -> Steerable:
        """As many scalars as vectors of each row, steered by its attribute."""
        steered = self.steered(values, attributes)
        passed, gates = steered.scalars.chunk(2, dim=1)
        return Steerable(SILU_GAIN * F.silu(passed), SIGMOID_GAIN * torch.sigmoid(gates)[:, None] * steered.vectors)


class SteerableMessagePassing(nn.Module):
    """A step of message passing between scalars and vectors, which are as many.

    A message is two gated blocks, steered by the attribute of the pair; a particle adds what a gated block and a
    steered linear map, steered by its own attribute, make of itself and of the sum of its messages.

    Args:
        width: Number of scalars and of vectors of a particle.
        generator: Source of the initial weights; None for torch's global one.
    """

    def __init__(self, width: int, generator: torch.Generator | None = None):
        super().__init__()
        latent, both = Kinds(width, width), Kinds(2 * width, 2 * width)
        pair = Kinds(both.scalars + 1, both.vectors + 1)
        self.first_message, self.message = GatedBlock(pair, width, generator), GatedBlock(latent, width, generator)
        self.first_update = GatedBlock(both, width, generator)
        self.update = SteeredLinear(latent, latent, generator)

    def forward(self, particles: Steerable, geometry: SteerableGeometry, attributes: Float[Tensor, "N 4"]) -> Steerable:
        """Scalars and vectors of the particles, whose attributes are given, a step later."""
        edges = geometry.edges
        pairs = side_by_side([particles.rows(edges.senders), particles.rows(edges.receivers), geometry.relative])
        messages = self.message(self.first_message(pairs, geometry.attributes), geometry.attributes)
        known = side_by_side([particles, messages.summed(edges.row_splits)])
        return particles.plus(self.update(self.first_update(known, attributes), attributes))
