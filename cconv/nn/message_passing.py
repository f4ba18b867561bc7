r"""Message passing between particles: multilayer perceptrons of pairs and of particles, and sums over neighbours.

A step updates the latent values e of each pair (receiver i, sender j) and n of each particle:

.. math::
    e'_{ij} = \mathrm{MLP}([e_{ij}, n_j, n_i]) \qquad
    n'_i = \mathrm{MLP}([n_i, \sum_j e'_{ij}]) \qquad
    e \leftarrow e + e', \; n \leftarrow n + n'

Source: Sanchez-Gonzalez et al., "Learning to Simulate Complex Physics with Graph Networks" (ICML 2020), section 3.2;
LagrangeBench (Toshev et al., NeurIPS 2023), `lagrangebench/models/gns.py`.
"""

from collections.abc import Sequence

import torch
import torch.nn.functional as F
from jaxtyping import Float, Int
from torch import Tensor, nn

from cconv.neighbors import Edges, join_edges
from cconv.nn.activations import ACTIVATIONS
from cconv.nn.layers import Layers
from cconv.ops import messages
from cconv.ops.messages import PairLayers


class PairGeometry:
    """Relative displacement and distance of each pair, in cutoffs.

    Args:
        edges: Pairs of receivers i and senders j.

    Attributes:
        edges: As given.
        features: (x_i - x_j) / R and |x_i - x_j| / R, (E, D + 1), R the cutoff.

    Raises:
        ShapeError: If the edges do not fit together or hold values that are not finite.
    """

    def __init__(self, edges: Edges):
        edges.check()
        self.edges = edges
        self.features = torch.cat([edges.displacements, edges.distances[:, None]], dim=1) / edges.cutoff

    def joined_with(self, others: "Sequence[PairGeometry]") -> "PairGeometry":
        """The geometry of this window and of others in one graph."""
        return PairGeometry(join_edges([self.edges, *(other.edges for other in others)]))

    @property
    def neighbor_counts(self) -> Int[Tensor, " N"]:
        """Number of neighbours of each receiver, itself not counted, (N,)."""
        return self.edges.neighbor_counts

    @property
    def nbytes(self) -> int:
        """Memory in bytes."""
        return self.features.nbytes + self.edges.nbytes


def segment_sums(values: Float[Tensor, "E C"], row_splits: Int[Tensor, " splits"]) -> Float[Tensor, "N C"]:
    """Sums (N, C) of the values (E, C) of the pairs of each receiver, whose pairs stand one after another; no atomics.

    Args:
        values: A row for each pair, sorted by receiver.
        row_splits: Pairs of receiver i stand at ``row_splits[i]:row_splits[i + 1]``, (N + 1,).
    """
    return torch.segment_reduce(values, "sum", offsets=row_splits, initial=0)


class MLP(nn.Module):
    """A multilayer perceptron, whose first layer takes several parts side by side.

    Weights are normal, cut off at two standard deviations of 1/√fan_in; biases are 0. Where a part belongs to
    particles and rows are pairs, the first layer is applied to the particles, before its products are gathered.

    Args:
        parts: Widths of the parts of the input.
        hidden: Widths of the hidden layers.
        outputs: Width of the output.
        activation: Name in `ACTIVATIONS`, after each hidden layer.
        norm: Whether a layer normalisation with scale and offset follows.
        generator: Source of the initial weights; None for torch's global one.
    """

    def __init__(
        self,
        parts: Sequence[int],
        hidden: Sequence[int],
        outputs: int,
        *,
        activation: str = "relu",
        norm: bool = True,
        generator: torch.Generator | None = None,
    ):
        super().__init__()
        self.parts, self.activation = list(parts), ACTIVATIONS[activation]
        widths = [sum(parts), *hidden, outputs]
        self.layers = Layers(
            linear(before, after, generator=generator) for before, after in zip(widths[:-1], widths[1:], strict=True)
        )
        self.norm = nn.LayerNorm(outputs) if norm else None

    def forward(
        self,
        first: Float[Tensor, "M C"],
        *gathered: tuple[Float[Tensor, "P B"], Int[Tensor, " M"] | None],
        onto: Float[Tensor, "M C_out"] | None = None,
    ) -> Float[Tensor, "M C_out"]:
        """Outputs (M, C_out) of the parts of the input.

        Args:
            first: First part (M, C).
            gathered: Further parts: values (P, B), and the row of the values that each row of the input takes (M,);
                None where they are its rows themselves.
            onto: What the outputs are added to; None for nothing.
        """
        own, *weights = self.layers[0].weight.split(self.parts, dim=1)
        products = [
            (None if rows is None else F.linear(part, weight), part, weight, rows)
            for weight, (part, rows) in zip(weights, gathered, strict=True)
        ]

        def some(begin: int, end: int) -> Tensor:
            values = F.linear(first[begin:end], own, self.layers[0].bias)
            for product, part, weight, rows in products:
                if product is None or rows is None:
                    values = values + F.linear(part[begin:end], weight)
                else:
                    values = values + product[rows[begin:end]]
            for layer in self.layers[1:]:
                values = layer(self.activation(values))
            values = values if self.norm is None else self.norm(values)
            return values if onto is None else onto[begin:end] + values

        if messages.applies(first, *(part for part, _ in gathered), *self.parameters()):
            output = first.new_empty(len(first), self.layers[-1].out_features)
            return messages.by_rows(some, output, sum(layer.weight.numel() for layer in self.layers))
        return some(0, first.shape[0])


def linear(inputs: int, outputs: int, generator: torch.Generator | None = None) -> nn.Linear:
    """A linear map whose weights are normal, cut off at two standard deviations of 1/√fan_in, with a bias of 0."""
    layer = nn.utils.skip_init(nn.Linear, inputs, outputs)
    deviation = max(inputs, 1) ** -0.5
    nn.init.trunc_normal_(layer.weight, std=deviation, a=-2 * deviation, b=2 * deviation, generator=generator)
    nn.init.zeros_(layer.bias)
    return layer


class MessagePassing(nn.Module):
    """A step of message passing; equations in the module's docstring.

    Args:
        width: Width H of the latent values of particles and pairs.
        hidden: Widths of the hidden layers.
        activation: Name in `ACTIVATIONS`.
        generator: Source of the initial weights; None for torch's global one.
    """

    def __init__(
        self, width: int, hidden: Sequence[int], activation: str = "relu", generator: torch.Generator | None = None
    ):
        super().__init__()
        self.of_pairs = MLP([width] * 3, hidden, width, activation=activation, generator=generator)
        self.of_particles = MLP([width] * 2, hidden, width, activation=activation, generator=generator)

    def forward(
        self, particles: Float[Tensor, "N H"], pairs: Float[Tensor, "E H"], edges: Edges
    ) -> tuple[Float[Tensor, "N H"], Float[Tensor, "E H"]]:
        """Latent values of particles (N, H) and pairs (E, H) after the step.

        Where nothing is to be differentiated, those of the pairs are changed in place.
        """
        if messages.applies(particles, pairs, *self.parameters()):
            sums = self._sums_in_place(particles, pairs, edges)
        else:
            added = self.of_pairs(pairs, (particles, edges.senders), (particles, edges.receivers))
            sums, pairs = segment_sums(added, edges.row_splits), pairs + added
        return self.of_particles(particles, (sums, None), onto=particles), pairs

    def _sums_in_place(self, particles: Tensor, pairs: Tensor, edges: Edges) -> Tensor:
        """Sums of the messages to each particle, which are added to the pairs."""
        (entry, *rest), norm = self.of_pairs.layers, self.of_pairs.norm
        assert norm is not None
        own, of_senders, of_receivers = entry.weight.split(self.of_pairs.parts, dim=1)
        layers = PairLayers(
            first=own,
            following=[(layer.weight, layer.bias) for layer in rest],
            activation=self.of_pairs.activation,
            scale=norm.weight,
            offset=norm.bias,
            smallest=norm.eps,
        )
        products = _products(particles, of_senders, None), _products(particles, of_receivers, entry.bias)
        return messages.pass_messages(pairs, *products, edges.senders, edges.row_splits, layers)


def _products(values: Tensor, weights: Tensor, bias: Tensor | None) -> Tensor:
    """A linear map of rows, which is not differentiated."""
    output = values.new_empty(len(values), len(weights))
    return messages.by_rows(lambda begin, end: F.linear(values[begin:end], weights, bias), output, weights.numel())
