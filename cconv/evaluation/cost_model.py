"""What a prediction costs, known from a network's settings before anything is built: operations and memory traffic.

Both are counted along the paths that `cconv.ops` takes on the CPU where nothing is differentiated. A count takes some
ten microseconds, for searches that ask for thousands; `time_model` turns counts into time on a machine.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

from cconv.ops.general import multiplies_first
from cconv.ops.radial import MOST_OUTPUTS

_FLOAT, _INDEX = 4, 8  # bytes
_ARRAY = 2 * _FLOAT  # bytes that move where an array operation writes a value and the next one reads it

Channels = tuple[int, int]  # scalars, vectors


@dataclass(frozen=True, kw_only=True)
class Surroundings:
    """How many points a fluid particle of a scene has around it, on average.

    Attributes:
        fluid_density: Neighbours a unit of volume within reach, lengths in particle spacings; about 1 inside a fluid.
        boundary_density: Boundary points, likewise.
        boundary_points: Boundary points of the scene over its fluid particles.
    """

    fluid_density: float
    boundary_density: float = 0.0
    boundary_points: float = 0.0

    @classmethod
    def counted(
        cls,
        relative_cutoff: float,
        dim: int,
        neighbors: float,
        boundary_neighbors: float = 0.0,
        boundary_points: float = 0.0,
    ) -> "Surroundings":
        """From mean numbers of points within a cutoff, in particle spacings, in D dimensions."""
        volume = ball_volume(relative_cutoff, dim)
        return cls(
            fluid_density=neighbors / volume,
            boundary_density=boundary_neighbors / volume,
            boundary_points=boundary_points,
        )


def ball_volume(radius: float, dim: int) -> float:
    """Volume of a ball in D dimensions, length^D."""
    return math.pi ** (dim / 2) / math.gamma(dim / 2 + 1) * radius**dim


@dataclass(frozen=True, kw_only=True)
class Estimate:
    """Cost of one particle's prediction.

    Attributes:
        flops_per_particle: Multiplications and additions of the network.
        bytes_per_particle: Memory read and written by neighbour search, geometry and network; of the filters, which
            stay in the caches, what single pairs pick out of them.
    """

    flops_per_particle: float
    bytes_per_particle: float

    def __add__(self, other: "Estimate") -> "Estimate":
        return Estimate(
            flops_per_particle=self.flops_per_particle + other.flops_per_particle,
            bytes_per_particle=self.bytes_per_particle + other.bytes_per_particle,
        )


@dataclass(frozen=True)
class _Pairs:
    """Sending points and pairs, of each receiver."""

    senders: float
    neighbors: float


_Conv = tuple[Channels, Channels, _Pairs]  # inputs, outputs, between which points; a grid has scalars only


def estimate(
    network: Mapping[str, Any], *, dim: int, vector_output: bool, boundary_channels: int, surroundings: Surroundings
) -> Estimate:
    """Cost of one particle's prediction, its features given.

    Args:
        network: All settings of `cconv.models.model.NetworkConfig`.
        dim: Number of space dimensions D.
        vector_output: Whether the target is a vector.
        boundary_channels: Features of a boundary point, 0 where the scene has none; networks without `boundary` leave
            them out.
        surroundings: Points around a particle.
    """
    volume = ball_volume(network["relative_cutoff"], dim)
    fluid = _Pairs(1.0, surroundings.fluid_density * volume)
    boundary = _Pairs(surroundings.boundary_points, surroundings.boundary_density * volume)
    channels = boundary_channels if network["boundary"] else 0
    searched = [fluid, boundary] if channels else [fluid]
    if network["basis"] == "radial":
        convs, dense = _radial_layers(network, dim, vector_output, channels, fluid, boundary)
        parts = [_radial_conv(*conv, network["radial_terms"], dim) for conv in convs]
        parts += [_radial_geometry(network, dim, pairs, convs) for pairs in searched]
    else:
        convs, dense = _grid_layers(network, dim, vector_output, channels, fluid, boundary)
        parts = [_grid_conv(*conv, network, dim) for conv in convs]
        parts += [_grid_geometry(network, dim, pairs) for pairs in searched]
    parts += [_search(pairs, dim) for pairs in searched]
    parts += [_dense(before, after, dim) for before, after in dense]
    return sum(parts[1:], start=parts[0])


def _hidden_widths(network: Mapping[str, Any]) -> list[int]:
    layers, hidden = network["layers"], network["hidden_channels"]
    return [network["first_channels"], *[hidden] * (layers - 2)] if layers > 1 else []


def _own_channels(network: Mapping[str, Any], vector_output: bool) -> Channels:
    """Scalars and vectors of a particle itself that the first layer takes, beside a constant."""
    if network["message"] != "difference":
        return int(network["density"]), 1
    return int(network["density"] and vector_output), 0


def _grid_layers(
    network: Mapping[str, Any], dim: int, vector_output: bool, boundary_channels: int, fluid: _Pairs, boundary: _Pairs
) -> tuple[list[_Conv], list[tuple[Channels, Channels]]]:
    """Convolutions and fully connected layers of a `ConvNet`."""
    first, *rest = [*_hidden_widths(network), dim if vector_output else 1]
    differences = network["message"] == "difference"
    features = dim + 1 + network["density"] - differences
    own = _own_channels(network, vector_output)[0] if differences else features
    following = pairwise([(1 + bool(boundary_channels) + bool(own)) * first, *rest])
    hidden = [((before, 0), (after, 0)) for before, after in following]
    dense = [*([((own, 0), (first, 0))] if own else []), *hidden]
    convs = [(before, after, fluid) for before, after in [((features, 0), (first, 0)), *hidden]]
    if boundary_channels:
        convs.append(((boundary_channels, 0), (first, 0), boundary))
    return convs, dense


def _radial_layers(
    network: Mapping[str, Any], dim: int, vector_output: bool, boundary_channels: int, fluid: _Pairs, boundary: _Pairs
) -> tuple[list[_Conv], list[tuple[Channels, Channels]]]:
    """Convolutions and linear maps of a `RadialNet`; each vector of a hidden layer has a scalar for its gate."""
    hidden = [(width, width) for width in _hidden_widths(network)]
    own = _own_channels(network, vector_output)
    inputs = [(1 + network["density"] - (network["message"] == "difference"), 1), *hidden]
    outputs = [*((scalars + vectors, vectors) for scalars, vectors in hidden), (0, 1) if vector_output else (1, 0)]
    dense = [(before, after) for before, after in zip([own, *hidden], outputs, strict=True) if any(before)]
    convs = [(before, after, fluid) for before, after in zip(inputs, outputs, strict=True)]
    if boundary_channels:
        convs.append(((0, 1) if boundary_channels == dim else (boundary_channels, 0), outputs[0], boundary))
    return convs, dense


def _grid_conv(inputs: Channels, outputs: Channels, pairs: _Pairs, network: Mapping[str, Any], dim: int) -> Estimate:
    """Messages of a pair are added to the cells that it reads, or it reads products of the sender and all filters."""
    cells = network["kernel_size"] ** dim
    corners = 1 if network["interpolation"] == "nearest_neighbor" else 2**dim
    pair = _INDEX + (dim + 2) * _FLOAT
    return _convolved(inputs[0], outputs[0], cells, corners, pairs.senders, pairs.neighbors, pair)


def _convolved(
    inputs: int, outputs: int, cells: int, corners: int, senders: float, neighbors: float, pair_bytes: int
) -> Estimate:
    """As `cconv.ops.convolution.convolve` computes; `pair_bytes` say where a pair reads the filters."""
    products_first = multiplies_first(senders, 1.0, inputs, outputs)
    read = neighbors * corners * (outputs if products_first else inputs)
    multiplied = (senders if products_first else 1.0) * cells * inputs * outputs
    products = senders * cells * outputs * _ARRAY if products_first else 0.0
    return Estimate(
        flops_per_particle=2.0 * (read + multiplied) if outputs else 0.0,
        bytes_per_particle=neighbors * (pair_bytes + inputs * _FLOAT) + products + outputs * _ARRAY,
    )


def _radial_conv(inputs: Channels, outputs: Channels, pairs: _Pairs, terms: int, dim: int) -> Estimate:
    """Pairs read the filters of all outputs themselves where these are few; else messages of each are written down."""
    (scalars, vectors), (to_scalars, to_vectors) = inputs, outputs
    of_scalars, of_vectors = scalars + vectors, scalars + 2 * vectors
    components = scalars + dim * vectors
    if max(outputs) <= MOST_OUTPUTS:
        reads = of_scalars * to_scalars + (of_scalars + dim * vectors) * to_vectors
        flops = 2.0 * (
            3 * reads + dim * vectors + dim * to_vectors
        )  # two values and a message; projections, directions
        moved = 2 * _INDEX + (dim + 1 + components + reads) * _FLOAT
        added = (to_scalars + dim * to_vectors) * _ARRAY
        return Estimate(flops_per_particle=pairs.neighbors * flops, bytes_per_particle=pairs.neighbors * moved + added)
    written = Estimate(
        flops_per_particle=0.0,
        bytes_per_particle=pairs.neighbors * _ARRAY * (4 * components + 2 * of_scalars + 4 * dim * of_vectors),
    )
    shape = terms, min(2, terms), pairs.neighbors, pairs.neighbors, _INDEX + 3 * _FLOAT
    vector_parts = [_convolved(of_vectors, to_vectors, *shape)] * (dim if to_vectors else 0)
    return sum([_convolved(of_scalars, to_scalars, *shape), *vector_parts], start=written)


def _dense(inputs: Channels, outputs: Channels, dim: int) -> Estimate:
    """Linear map of scalars and vectors, and the few operations between layers."""
    weights = inputs[0] * outputs[0] + dim * inputs[1] * outputs[1]
    values = inputs[0] + outputs[0] + dim * (inputs[1] + outputs[1])
    return Estimate(flops_per_particle=2.0 * weights, bytes_per_particle=3.0 * values * _ARRAY)


def _search(pairs: _Pairs, dim: int) -> Estimate:
    """Points sorted into cells; both indices, displacement and distance of each pair."""
    pair = 2 * _INDEX + (dim + 2) * _FLOAT
    return Estimate(
        flops_per_particle=0.0, bytes_per_particle=8.0 * _INDEX * pairs.senders + 2.0 * pair * pairs.neighbors
    )


def _grid_geometry(network: Mapping[str, Any], dim: int, pairs: _Pairs) -> Estimate:
    """Arrays of all pairs on the way from displacements to cells, fractions and weights, as `nn.filters` makes them."""
    mapped = {
        "identity": 0,
        "ball_to_cube_radial": 4 * dim + 4,
        "ball_to_cube_volume_preserving": (0, 0, 20, 53)[dim],
    }[network["mapping"]]
    arrays = 12 * dim + mapped + _window_arrays(network)
    return Estimate(flops_per_particle=0.0, bytes_per_particle=float(_ARRAY * arrays * pairs.neighbors))


def _radial_geometry(network: Mapping[str, Any], dim: int, pairs: _Pairs, convs: Sequence[_Conv]) -> Estimate:
    """Arrays of all pairs: the window, and terms and directions where a convolution takes messages of each."""
    weighted = network["window"] != "none" or network["normalize"]
    arrays = _window_arrays(network) if weighted else 0
    if any(max(after) > MOST_OUTPUTS for _, after, between in convs if between is pairs):
        arrays += 3 * dim + 12
    return Estimate(flops_per_particle=0.0, bytes_per_particle=float(_ARRAY * arrays * pairs.neighbors))


def _window_arrays(network: Mapping[str, Any]) -> int:
    arrays = {"none": 1, "poly6": 6, "gaussian": 4, "cubic_spline": 14}[network["window"]]
    return arrays + 4 * network["normalize"]
