r"""Continuous convolution with radial filters, equivariant to rotations and reflections.

Filters are sums of radial terms φ_b(r) with learned coefficients c_b, and complete up to vectors. With the direction
:math:`\hat r = (x_j - x_i) / r`, messages s (scalars) and v (vectors) of an edge contribute

.. math::
    \text{to scalars:}\quad \phi s, \; \phi\, \hat r \cdot v
    \qquad\text{to vectors:}\quad \phi s\, \hat r, \; \phi v, \; \phi (\hat r \cdot v)\, \hat r

The terms are linear hats at evenly spaced distances from 0 to the cutoff R: filters are piecewise linear in r, as the
grid filters are in each coordinate. D2 and D3 of SPH are of this form, with φ = -W'(r).

These are all contributions that are linear in one message: see Villar et al., "Scalars are universal: Equivariant
machine learning, structured like classical physics" (NeurIPS 2021).

A message is f_j + σ f_i with a σ for scalars and one for vectors. "mixed" messages are scalars as they are and
differences of vectors, so that velocities matter only relative to each other. "opposite" messages are sums of scalars
and differences of vectors: what two particles add to each other's vectors is equal and opposite, so that its sum over
all particles is 0.
"""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import cached_property, partial

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from cconv.errors import ConfigError, ShapeError, check_choice, check_shape
from cconv.neighbors import Edges, join_edges
from cconv.nn.continuous_conv import (
    check_finite,
    check_kind,
    importance,
    uniform_filters,
)
from cconv.nn.filters import WINDOWS, interpolate
from cconv.nn.kinds import Kinds, join_kinds, split_kinds
from cconv.ops import radial, radial_columns, recomputed
from cconv.ops.convolution import columns, convolve
from cconv.ops.filter_reads import FilterReads
from cconv.ops.radial_columns import WeightedEdges
from cconv.ops.recomputed import Block, Graph, by_blocks, stencil_of

MESSAGES = {"absolute": (0, 0), "difference": (-1, -1), "sum": (1, 1), "mixed": (0, -1), "opposite": (1, -1)}


class RadialGeometry:
    """Radial terms and direction of each edge, computed once and shared by all layers with the same settings.

    Args:
        edges: Pairs of receivers i and senders j.
        num_terms: Number of radial terms B.
        window: Radial weight a_R: "none", "poly6", "gaussian" or "cubic_spline".
        normalize: Whether to divide by ψ, the sum of a receiver's window values.
        detach_positions: Whether to hold positions constant.

    Attributes:
        edges: As given.
        num_terms: As given.
        bipartite: Whether receivers and senders are different points.
        receivers: Receiver i of each edge, (E,).
        senders: Sender j of each edge, (E,).
        num_senders: Number of points that could send.

    Raises:
        ConfigError: If the window is unknown or there is no term.
        ShapeError: If the edges do not fit together or hold values that are not finite.
    """

    def __init__(
        self,
        edges: Edges,
        num_terms: int,
        window: str = "none",
        normalize: bool = False,
        detach_positions: bool = False,
    ):
        edges.check()
        check_choice("window", window, WINDOWS)
        if not (isinstance(num_terms, int) and num_terms >= 1):
            raise ConfigError(f"`num_terms` must be a positive whole number, got {num_terms!r}.")
        self.edges, self.num_terms = edges, num_terms
        self.bipartite = edges.bipartite
        self.receivers, self.senders, self.num_senders = edges.receivers, edges.senders, edges.num_senders
        self._window, self._normalize = window, normalize
        self._differentiates = torch.is_grad_enabled() and not detach_positions

    def joined_with(self, others: "Sequence[RadialGeometry]") -> "RadialGeometry":
        """The geometry of this window and of others in one graph; all with the same settings."""
        edges = join_edges([self.edges, *(other.edges for other in others)])
        return RadialGeometry(edges, self.num_terms, self._window, self._normalize, not self._differentiates)

    @property
    def batch_index(self) -> Int[Tensor, " N"] | None:
        """Window of each receiver (N,) where several windows stand in one graph; None for one window."""
        return self.edges.batch_index

    @property
    def dim(self) -> int:
        """Number of space dimensions D."""
        return self.edges.dim

    @property
    def num_receivers(self) -> int:
        """Number of receiving points."""
        return self.edges.num_receivers

    @property
    def neighbor_counts(self) -> Int[Tensor, " N"]:
        """Number of neighbours of each receiver, itself not counted, (N,)."""
        return self.edges.neighbor_counts

    @property
    def nbytes(self) -> int:
        """Largest memory in bytes: with all that convolutions could add on first use, of which most need little."""
        edges = self.edges
        values = 2 * edges.displacements.nbytes + 3 * edges.distances.nbytes  # also directions; fractions, weights
        indices = 4 * 8 + 3 * 4  # of an edge: both points, itself, its place; its cell, two orders by sender
        return values + indices * len(edges) + 8 * (edges.num_receivers + edges.num_senders + 3)

    @cached_property
    def directions(self) -> Float[Tensor, "E {self.dim}"]:
        """(x_j - x_i) / r, (E, D); 0 where two points coincide."""
        with self._gradients():
            apart = torch.where(self.edges.distances > 0, self.edges.distances, 1.0)
            return -self.edges.displacements / apart[:, None]

    @cached_property
    def weights(self) -> Float[Tensor, " E"] | None:
        """Window of each edge (E,), divided by ψ if normalised; None where all weigh 1."""
        if self._window == "none" and not self._normalize:
            return None
        with self._gradients():
            return importance(self.edges, self._window, self._normalize)

    @cached_property
    def weighted_edges(self) -> WeightedEdges:
        """Edges and their weights for compiled loops in both directions."""
        return WeightedEdges(edges=self.edges, weights=self.weights)

    @cached_property
    def reads(self) -> FilterReads:
        """Terms of each edge, which counts as a sender of its own."""
        edges, terms = self.edges, self.num_terms
        with self._gradients():
            place = (edges.distances / edges.cutoff)[:, None] * (terms - 1)
            lowest, fractions, ones = interpolate(place, (terms,), "linear")
            return FilterReads(
                row_splits=edges.row_splits,
                receivers=edges.receivers,
                senders=torch.arange(edges.num_pairs, device=edges.senders.device),
                cells=lowest[:, 0].contiguous(),
                fractions=fractions,
                weights=ones if self.weights is None else self.weights,
                corner_offsets=(0, min(1, terms - 1)),
                num_cells=terms,
                num_senders=edges.num_pairs,
            )

    @contextmanager
    def _gradients(self) -> Iterator[None]:
        """As when the geometry was made, whatever the mode in which a part of it is first asked for."""
        with torch.inference_mode(False), torch.set_grad_enabled(self._differentiates):
            yield

    def messages(
        self, features: Float[Tensor, "M C"], channels: Kinds, message: str
    ) -> tuple[Float[Tensor, "E to_scalars"], Float[Tensor, "{self.dim} E to_vectors"]]:
        """What each edge contributes before the radial terms.

        Returns:
            For scalars s and r̂ · v, (E, S + V); for vectors s r̂, v and (r̂ · v) r̂, (D, E, S + 2V).
        """
        own = _own_factors(channels, self.dim, message, features)
        sent = features[self.senders] if own is None else features[self.senders] + own * features[self.receivers]
        return _contributions(sent, self.directions, channels)


def _own_factors(channels: Kinds, dim: int, message: str, like: Tensor) -> Float[Tensor, " C"] | None:
    """What a receiver's own values (S + V · D) are multiplied by in a message; None where they are not read."""
    of_scalars, of_vectors = MESSAGES[message]
    if of_scalars == of_vectors == 0:
        return None
    return like.new_tensor([float(of_scalars)] * channels.scalars + [float(of_vectors)] * (channels.vectors * dim))


def _contributions(
    sent: Float[Tensor, "E C"], directions: Float[Tensor, "E D"], channels: Kinds
) -> tuple[Float[Tensor, "E to_scalars"], Float[Tensor, "D E to_vectors"]]:
    """What messages (E, S + V · D) contribute along directions (E, D) before the radial terms."""
    scalars, vectors = split_kinds(sent, channels, directions.shape[1])
    along = torch.einsum("evd,ed->ev", vectors, directions)
    directed = torch.cat([scalars, along], dim=1)[:, :, None] * directions[:, None, :]
    to_scalars = torch.cat([scalars, along], dim=1)
    # Directed scalars, vectors, directed projections.
    to_vectors = torch.cat([directed[:, : channels.scalars], vectors, directed[:, channels.scalars :]], dim=1)
    return to_scalars, to_vectors.permute(2, 0, 1)


class RadialConv(nn.Module):
    """A continuous convolution with radial filters; equations in the module's docstring.

    Values hold scalars first, then the D components of each vector: (N, S + V · D).

    Args:
        in_channels: Scalars and vectors of a sender.
        out_channels: Scalars and vectors of a receiver.
        num_terms: Number of radial terms B.
        dim: Number of space dimensions D.
        bias: Whether to add a learned bias to the scalars, 0 at first; vectors have none.
        message: "absolute", "difference", "sum", "mixed" or "opposite": a name in `MESSAGES`.
        generator: Source of the initial weights (Xavier-uniform); None for torch's global one.
    """

    def __init__(
        self,
        in_channels: Kinds,
        out_channels: Kinds,
        num_terms: int,
        dim: int,
        *,
        bias: bool = True,
        message: str = "absolute",
        generator: torch.Generator | None = None,
    ):
        super().__init__()
        check_choice("message", message, MESSAGES)
        self.in_channels, self.out_channels = in_channels, out_channels
        self.dim, self.message = dim, message
        scalars, vectors = in_channels
        self.scalar_filters = uniform_filters((num_terms,), scalars + vectors, out_channels.scalars, generator)
        self.vector_filters = uniform_filters((num_terms,), scalars + 2 * vectors, out_channels.vectors, generator)
        self.bias = nn.Parameter(torch.zeros(out_channels.scalars)) if bias else None

    def forward(self, features: Float[Tensor, "M C_in"], geometry: RadialGeometry) -> Float[Tensor, "N C_out"]:
        """Values (M, S_in + V_in · D) of the senders to (N, S_out + V_out · D) at the receivers.

        Raises:
            ShapeError: If shapes, dtypes or devices do not fit together, or a value is not finite.
            ConfigError: If the message is not possible.
        """
        self._check(features, geometry)
        check_finite("features", features)
        return self.convolve(features, geometry)

    def convolve(self, features: Float[Tensor, "M C_in"], geometry: RadialGeometry) -> Float[Tensor, "N C_out"]:
        """`forward` without its checks, for hidden layers."""
        filters = self.scalar_filters, self.vector_filters
        own = MESSAGES[self.message]
        if radial.applies(features, *filters, geometry.edges):
            output = radial.convolve(features, *filters, geometry.edges, geometry.weights, own)
        elif radial_columns.applies(features, geometry.weighted_edges):
            general = partial(self._convolve_generally, geometry=geometry)
            output = radial_columns.convolve(features, *filters, geometry.weighted_edges, own, general)
        elif recomputed.applies(features):
            output = self._convolve_by_blocks(features, *filters, geometry)
        else:
            output = self._convolve_generally(features, *filters, geometry)
        if self.bias is None:
            return output
        return torch.cat([output[:, : len(self.bias)] + self.bias, output[:, len(self.bias) :]], dim=1)

    def columns(
        self, features: Float[Tensor, "M C_in"], geometry: RadialGeometry
    ) -> tuple[Float[Tensor, "N P"], Float[Tensor, "R Q"]]:
        """Gather the messages into radial terms, not differentiable.

        The convolution without bias is these times the flattened filters of scalars (B · (S + V), S_out) and of vectors
        (B · (S + 2V), V_out).

        Returns:
            Of each receiver (N, B · (S + V)), and of the components of its vectors (N · D, B · (S + 2V)).
        """
        own, num_terms = MESSAGES[self.message], geometry.num_terms
        with torch.no_grad():
            if radial_columns.applies(features, geometry.weighted_edges):
                return radial_columns.columns(features, self.in_channels, geometry.weighted_edges, own, num_terms)
            to_scalars, to_vectors = geometry.messages(features, self.in_channels, self.message)
            components = [columns(component, geometry.reads) for component in to_vectors]
            return columns(to_scalars, geometry.reads), torch.stack(components, dim=1).flatten(0, 1)

    def _convolve_generally(
        self, features: Tensor, scalar_filters: Tensor, vector_filters: Tensor, geometry: RadialGeometry
    ) -> Tensor:
        """Any device and dtype, differentiable also in positions: convolutions of what each edge sends."""
        to_scalars, to_vectors = geometry.messages(features, self.in_channels, self.message)
        scalars = convolve(to_scalars, scalar_filters, geometry.reads)
        if self.out_channels.vectors == 0:
            return scalars
        vectors = [convolve(component, vector_filters, geometry.reads) for component in to_vectors]
        return join_kinds(scalars, torch.stack(vectors, dim=2))

    def _convolve_by_blocks(
        self, features: Tensor, scalar_filters: Tensor, vector_filters: Tensor, geometry: RadialGeometry
    ) -> Tensor:
        """The same with a memory that grows with neither edges nor columns, on devices without compiled loops."""
        kinds, dim, reads = self.in_channels, self.dim, geometry.reads
        own = _own_factors(kinds, dim, self.message, features)
        width = (kinds.scalars + kinds.vectors) + dim * (kinds.scalars + 2 * kinds.vectors)

        def compute(
            block: Block, sent: Tensor, received: Tensor, per_edge: Sequence[Tensor], filters: Sequence[Tensor]
        ) -> Tensor:
            directions, fractions, weights = per_edge
            if own is not None:
                sent = sent + (own * received).repeat_interleave(block.counts, 0, output_size=len(sent))
            to_scalars, to_vectors = _contributions(sent, directions, kinds)
            messages = torch.cat([to_scalars, *to_vectors.unbind(0)], dim=1)
            columns = block.columns(messages, stencil_of(reads, block.edges, fractions, weights))
            of_scalars, of_vectors = columns.split([to_scalars.shape[1], dim * to_vectors.shape[2]], dim=2)
            scalars = of_scalars.flatten(1) @ filters[0].flatten(0, 1)
            components = of_vectors.unflatten(2, (dim, to_vectors.shape[2])).transpose(1, 2).flatten(2)
            return join_kinds(scalars, (components @ filters[1].flatten(0, 1)).transpose(1, 2))

        def again(features: Tensor, per_edge: Sequence[Tensor], filters: Sequence[Tensor]) -> Tensor:
            return self._convolve_generally(features, filters[0], filters[1], geometry)

        return by_blocks(
            compute,
            features,
            per_edge=(geometry.directions, reads.fractions, reads.weights),
            shared=(scalar_filters, vector_filters),
            graph=Graph(geometry.edges.row_splits, geometry.senders, own is not None),
            values=(geometry.num_terms * width, geometry.num_terms + 2 * width),
            outputs=self.out_channels.num_values(dim),
            again=again,
        )

    def _check(self, features: Tensor, geometry: RadialGeometry) -> None:
        if self.message != "absolute" and geometry.bipartite:
            raise ConfigError("`message` must be 'absolute' where receivers and senders are different points.")
        if geometry.num_terms != len(self.scalar_filters) or geometry.dim != self.dim:
            raise ShapeError(
                f"`geometry` must have {len(self.scalar_filters)} terms in {self.dim} dimensions, got "
                f"{geometry.num_terms} in {geometry.dim}."
            )
        check_shape("features", features.shape, (geometry.num_senders, self.in_channels.num_values(self.dim)))
        check_kind(geometry.edges.distances, features=features, filters=self.scalar_filters)
