"""Neighbour search within a cutoff: a full list of pairs, sorted by receiver."""

from dataclasses import dataclass, replace

import numpy as np
import torch
from scipy.spatial import cKDTree
from torch import Tensor

from cconv.domain import Box
from cconv.errors import ConfigError, ShapeError, check_shape


@dataclass(frozen=True, kw_only=True)
class Edges:
    """Pairs of particles within a cutoff, in compressed rows: all pairs of receiver 0 first, then those of 1, ...

    With i = receiver and j = sender, both directions of a pair are listed.

    Attributes:
        receivers: Index i of the particle that gathers, (E,), int64, ascending.
        senders: Index j of its neighbour, (E,), int64, ascending within a receiver.
        displacements: x_i - x_j with minimum image, (E, D).
        distances: |x_i - x_j|, (E,).
        row_splits: Pairs of receiver i stand at ``row_splits[i]:row_splits[i + 1]``, (receivers + 1,), int64.
        num_senders: Number of points that could send.
        cutoff: Largest distance listed, inclusive.
        bipartite: Whether receivers and senders are different sets of points.
        includes_self: Whether each particle is listed as its own neighbour.
    """

    receivers: Tensor
    senders: Tensor
    displacements: Tensor
    distances: Tensor
    row_splits: Tensor
    num_senders: int
    cutoff: float
    bipartite: bool
    includes_self: bool

    @property
    def num_receivers(self) -> int:
        """Number of receiving points, those without a neighbour included."""
        return len(self.row_splits) - 1

    @property
    def dim(self) -> int:
        """Number of space dimensions D."""
        return self.displacements.shape[1]

    def __len__(self) -> int:
        return len(self.receivers)

    def to(self, *args, **kwargs) -> "Edges":
        """Edges with distances and displacements converted, and all tensors moved, as `torch.Tensor.to` does."""
        displacements = self.displacements.to(*args, **kwargs)
        device = displacements.device
        return replace(
            self,
            receivers=self.receivers.to(device),
            senders=self.senders.to(device),
            displacements=displacements,
            distances=self.distances.to(*args, **kwargs),
            row_splits=self.row_splits.to(device),
        )


def radius_graph(
    positions: Tensor, cutoff: float, box: Box | None = None, queries: Tensor | None = None, include_self: bool = False
) -> Edges:
    """All pairs within `cutoff`, found with SciPy's k-d tree.

    Receivers are the queries (by default the positions themselves), senders the positions. Displacements and distances
    are differentiable with respect to both; which pairs are listed is not. Particles at exactly the same place are
    neighbours of each other.

    Args:
        positions: Sending points (M, D), D from 1 to 3.
        cutoff: Largest distance of a pair, inclusive; at most half the length of every periodic axis.
        box: Domain with its periodic axes; None for open space.
        queries: Receiving points (N, D), e.g. fluid particles that look for boundary points.
        include_self: Whether a particle is its own neighbour; only without `queries`.

    Returns:
        The pairs, sorted by receiver, then sender.

    Raises:
        ShapeError: If shapes or dtypes do not fit or a coordinate is not finite.
        ConfigError: If the cutoff is not positive or exceeds half of a periodic axis, or `include_self` comes with
            `queries`.
    """
    receivers_at = positions if queries is None else queries
    _check_points(positions, receivers_at, box)
    _check_cutoff(cutoff, box)
    if include_self and queries is not None:
        raise ConfigError("`include_self` must be False with `queries`: they are other points than `positions`.")
    if queries is None:
        receivers, senders = _pairs_within(_tree(positions, box), cutoff, include_self)
    else:
        receivers, senders = _pairs_between(_tree(queries, box), _tree(positions, box), cutoff)
    pairs = np.sort(receivers * len(positions) + senders)  # sorting one number a pair is faster than an order of them
    receivers = pairs // max(len(positions), 1)
    senders = pairs - receivers * len(positions)
    row_splits = np.zeros(len(receivers_at) + 1, dtype=np.int64)
    np.cumsum(np.bincount(receivers, minlength=len(receivers_at)), out=row_splits[1:])
    receivers, senders, row_splits = (
        torch.from_numpy(array).to(positions.device) for array in (receivers, senders, row_splits)
    )
    to, origin = receivers_at[receivers], positions[senders]
    displacements = to - origin if box is None else box.displacement(to, origin)
    return Edges(
        receivers=receivers,
        senders=senders,
        displacements=displacements,
        distances=torch.linalg.vector_norm(displacements, dim=1),
        row_splits=row_splits,
        num_senders=len(positions),
        cutoff=float(cutoff),
        bipartite=queries is not None,
        includes_self=include_self,
    )


def half_list(positions: Tensor, cutoff: float, box: Box | None = None) -> np.ndarray:
    """Pairs within `cutoff` without distances, each listed once: (P, 2), in no particular order.

    Arguments and errors are those of `radius_graph`.
    """
    _check_points(positions, positions, box)
    _check_cutoff(cutoff, box)
    return _tree(positions, box).query_pairs(cutoff, output_type="ndarray").reshape(-1, 2)


def _check_points(positions: Tensor, queries: Tensor, box: Box | None) -> None:
    for name, points in (("positions", positions), ("queries", queries)):
        if points.ndim != 2 or not 1 <= points.shape[1] <= 3:
            raise ShapeError(f"`{name}` must have shape (particles, dim) with dim 1 to 3, got {tuple(points.shape)}.")
        if not points.is_floating_point():
            raise ShapeError(f"`{name}` must be floating point, got {points.dtype}.")
        if not torch.isfinite(points).all():
            raise ShapeError(f"`{name}` must be finite, got NaN or infinity; look for a simulation that blew up.")
    check_shape("queries", queries.shape, ("queries", positions.shape[1]))
    if queries.dtype != positions.dtype or queries.device != positions.device:
        raise ShapeError(
            f"`queries` must share dtype and device with `positions` ({positions.dtype}, {positions.device}), "
            f"got {queries.dtype}, {queries.device}."
        )
    if box is not None and box.dim != positions.shape[1]:
        raise ShapeError(f"`box` must have as many axes as `positions` ({positions.shape[1]}), got {box.dim}.")


def _check_cutoff(cutoff: float, box: Box | None) -> None:
    if not cutoff > 0:
        raise ConfigError(f"`cutoff` must be positive, got {cutoff}.")
    if box is None:
        return
    for axis, (length, periodic) in enumerate(zip(box.lengths, box.periodic, strict=True)):
        if periodic and cutoff > length / 2:
            raise ConfigError(
                f"`cutoff` must be at most half of every periodic axis, got {cutoff} on axis {axis} of length {length}."
            )


def _tree(points: Tensor, box: Box | None) -> cKDTree:
    coordinates = points.detach().cpu().double()
    if box is None or not any(box.periodic):
        return cKDTree(coordinates.numpy())
    # SciPy takes periodic axes as [0, length) and a length of 0 for an open axis.
    lower = torch.tensor(box.lower, dtype=torch.float64)
    offset = (box.wrap(coordinates) - lower).numpy()
    lengths = np.where(box.periodic, box.lengths, 0.0)
    inside = np.where(np.array(box.periodic) & (offset >= box.lengths), 0.0, offset)
    return cKDTree(inside, boxsize=lengths)


def _pairs_within(tree: cKDTree, cutoff: float, include_self: bool) -> tuple[np.ndarray, np.ndarray]:
    half = tree.query_pairs(cutoff, output_type="ndarray").astype(np.int64).reshape(-1, 2)
    own = np.arange(tree.n if include_self else 0, dtype=np.int64)
    return np.concatenate([half[:, 0], half[:, 1], own]), np.concatenate([half[:, 1], half[:, 0], own])


def _pairs_between(queries: cKDTree, points: cKDTree, cutoff: float) -> tuple[np.ndarray, np.ndarray]:
    if queries.n == 0 or points.n == 0:
        return np.zeros(0, dtype=np.int64), np.zeros(0, dtype=np.int64)
    pairs = queries.sparse_distance_matrix(points, cutoff, output_type="ndarray")
    return pairs["i"].astype(np.int64), pairs["j"].astype(np.int64)
