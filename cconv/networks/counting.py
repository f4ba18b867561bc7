"""The counted cost of a prediction, operations and memory traffic, from the settings of a network before it is built.

Both are counted for the paths that `cconv.ops` takes on the CPU without derivatives. A count takes some ten
microseconds, because a search needs thousands. This module has the parts that networks share; each network counts its
own layers.
"""

import math
from collections.abc import Iterable
from dataclasses import dataclass

from cconv.nn.kinds import Kinds
from cconv.ops.general import multiplies_first

FLOAT, INDEX = 4, 8  # bytes
ARRAY = 2 * FLOAT  # bytes moved if an array operation writes a value and the next one reads it


@dataclass(frozen=True, kw_only=True)
class NeighborDensity:
    """Mean density of points around a fluid particle of a scene.

    Attributes:
        fluid: Neighbours per unit of volume, lengths in particle spacings; about 1 inside a fluid.
        walls: Boundary points per unit of volume, likewise.
        wall_points: Boundary points of the scene ÷ its fluid particles.
    """

    fluid: float
    walls: float = 0.0
    wall_points: float = 0.0

    @classmethod
    def counted(
        cls,
        relative_cutoff: float,
        dim: int,
        neighbors: float,
        wall_neighbors: float = 0.0,
        wall_points: float = 0.0,
    ) -> "NeighborDensity":
        """From mean numbers of points within a cutoff, in particle spacings, in D dimensions."""
        volume = ball_volume(relative_cutoff, dim)
        return cls(fluid=neighbors / volume, walls=wall_neighbors / volume, wall_points=wall_points)

    def pairs(self, relative_cutoff: float, dim: int) -> tuple["Pairs", "Pairs"]:
        """Pairs of a receiver with the fluid and with the walls within a cutoff."""
        volume = ball_volume(relative_cutoff, dim)
        return Pairs(1.0, self.fluid * volume), Pairs(self.wall_points, self.walls * volume)


def ball_volume(radius: float, dim: int) -> float:
    """Volume of a ball in D dimensions, length^D."""
    return math.pi ** (dim / 2) / math.gamma(dim / 2 + 1) * radius**dim


@dataclass(frozen=True, kw_only=True)
class CountedCost:
    """Cost of a prediction per particle.

    Attributes:
        flops_per_particle: Multiplications and additions of the network.
        bytes_per_particle: Bytes moved by neighbour search, geometry and network. Filters are assumed to stay in the
            cache, so only the values that each pair reads from them are counted; so are columns of radial layers, which
            are counted once a particle.
    """

    flops_per_particle: float = 0.0
    bytes_per_particle: float = 0.0

    def __add__(self, other: "CountedCost") -> "CountedCost":
        return CountedCost(
            flops_per_particle=self.flops_per_particle + other.flops_per_particle,
            bytes_per_particle=self.bytes_per_particle + other.bytes_per_particle,
        )

    def __mul__(self, times: float) -> "CountedCost":
        return CountedCost(
            flops_per_particle=times * self.flops_per_particle, bytes_per_particle=times * self.bytes_per_particle
        )


def total(parts: Iterable[CountedCost]) -> CountedCost:
    """Sum of costs."""
    return sum(parts, start=CountedCost())


@dataclass(frozen=True)
class Pairs:
    """Sending points and pairs, of each receiver."""

    senders: float
    neighbors: float


@dataclass(frozen=True)
class CountedConv:
    """A convolution whose cost is counted: what it takes, what it gives, between which points."""

    inputs: Kinds
    outputs: Kinds
    pairs: Pairs


def count_filters(
    inputs: int, outputs: int, cells: int, corners: int, senders: float, neighbors: float, pair_bytes: int
) -> CountedCost:
    """Count a convolution of scalars as `cconv.ops.convolution.convolve` computes it.

    Either the message of a pair is added to the filter cells that it reads, or the pair reads the products of the
    sender with all filters. `pair_bytes` is the memory that tells where a pair reads the filters.
    """
    products_first = multiplies_first(senders, 1.0, inputs, outputs)
    read = neighbors * corners * (outputs if products_first else inputs)
    multiplied = (senders if products_first else 1.0) * cells * inputs * outputs
    products = senders * cells * outputs * ARRAY if products_first else 0.0
    return CountedCost(
        flops_per_particle=2.0 * (read + multiplied) if outputs else 0.0,
        bytes_per_particle=neighbors * (pair_bytes + inputs * FLOAT) + products + outputs * ARRAY,
    )


def count_linear(inputs: Kinds, outputs: Kinds, dim: int) -> CountedCost:
    """Cost of a linear map of scalars and vectors, and of the few operations between layers."""
    weights = inputs.scalars * outputs.scalars + dim * inputs.vectors * outputs.vectors
    values = inputs.num_values(dim) + outputs.num_values(dim)
    return CountedCost(flops_per_particle=2.0 * weights, bytes_per_particle=3.0 * values * ARRAY)


def count_search(pairs: Pairs, dim: int) -> CountedCost:
    """Cost of a neighbour search: points sorted into cells; both indices, displacement and distance of each pair."""
    pair = 2 * INDEX + (dim + 2) * FLOAT
    return CountedCost(bytes_per_particle=8.0 * INDEX * pairs.senders + 2.0 * pair * pairs.neighbors)


def count_arrays(arrays: int, pairs: Pairs) -> CountedCost:
    """Cost of so many arrays of all pairs, written and read once."""
    return CountedCost(bytes_per_particle=float(ARRAY * arrays * pairs.neighbors))


def window_arrays(window: str, normalize: bool) -> int:
    """Arrays of all pairs that a window, and dividing by its sum, takes."""
    return {"none": 1, "poly6": 6, "gaussian": 4, "cubic_spline": 14}[window] + 4 * normalize
