"""Neighbour search within a cutoff: a full list of pairs, sorted by receiver."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from cconv import tensor_cell_list
from cconv.batching import check_batch_index, counts_of, index_of, joined_indices, joined_splits
from cconv.cell_list import CellGrid, Cells, half_pairs, pairs_by_receiver, separations
from cconv.devices import finest_dtype
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
        distances: their lengths, (E,).
        row_splits: Pairs of receiver i stand at ``row_splits[i]:row_splits[i + 1]``, (receivers + 1,), int64.
        num_senders: Number of points that could send.
        cutoff: Largest distance listed, inclusive.
        bipartite: Whether receivers and senders are different sets of points.
        includes_self: Whether each particle is listed as its own neighbour.
        batch_index: Window of each receiver (N,) where several windows stand in one graph; None for one window.
    """

    receivers: Int[Tensor, " E"]
    senders: Int[Tensor, " E"]
    displacements: Float[Tensor, "E D"]
    distances: Float[Tensor, " E"]
    row_splits: Int[Tensor, " splits"]
    num_senders: int
    cutoff: float
    bipartite: bool
    includes_self: bool
    batch_index: Int[Tensor, " N"] | None = None

    @property
    def num_receivers(self) -> int:
        """Number of receiving points, those without a neighbour included."""
        return self.row_splits.shape[0] - 1

    @property
    def num_pairs(self) -> int:
        """Number of pairs E, also in a graph that is compiled for any."""
        return self.receivers.shape[0]

    @property
    def neighbor_counts(self) -> Int[Tensor, " N"]:
        """Number of neighbours of each receiver, itself not counted, (N,)."""
        return self.row_splits.diff() - int(self.includes_self)

    @property
    def dim(self) -> int:
        """Number of space dimensions D."""
        return self.displacements.shape[1]

    @property
    def nbytes(self) -> int:
        """Memory in bytes."""
        tensors = (self.receivers, self.senders, self.displacements, self.distances, self.row_splits)
        return sum(tensor.nbytes for tensor in tensors)

    def __len__(self) -> int:
        return len(self.receivers)

    def apart(self) -> "Edges":
        """Pairs of points that are not at exactly the same place."""
        kept = self.distances > 0
        if not torch.compiler.is_compiling() and kept.all():
            return self
        ends = torch.cat([kept.new_zeros(1, dtype=torch.int64), kept.cumsum(0)])
        return replace(
            self,
            receivers=self.receivers[kept],
            senders=self.senders[kept],
            displacements=self.displacements[kept],
            distances=self.distances[kept],
            row_splits=ends[self.row_splits],
        )

    def check(self) -> None:
        """Require pairs that compiled loops can follow; a compiled graph cannot ask, and does not.

        Raises:
            ShapeError: If pairs, row splits and numbers of points do not fit, or a displacement is not finite.
        """
        if torch.compiler.is_compiling():
            return
        if not _all_finite(self.displacements):
            raise ShapeError("`edges` must have finite displacements, got NaN or infinity; look at the positions.")
        lengths = {len(self.senders), len(self.receivers), len(self.displacements), int(self.row_splits[-1])}
        fits = len(lengths) == 1 and int(self.row_splits[0]) == 0 and not (self.row_splits.diff() < 0).any()
        within = _all_below(self.senders, self.num_senders) and _all_below(self.receivers, self.num_receivers)
        if not (fits and within):
            raise ShapeError(
                f"`edges` must list pairs among {self.num_receivers} receivers and {self.num_senders} senders, got row "
                "splits or indices beyond that; build them with `radius_graph`."
            )

    def to(self, *args: Any, **kwargs: Any) -> "Edges":
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
            batch_index=None if self.batch_index is None else self.batch_index.to(device),
        )


def join_edges(parts: Sequence[Edges]) -> Edges:
    """Pairs of several windows in one graph, whose points stand one window after another.

    Args:
        parts: Pairs of each window, at least one, of the same cutoff and kind.
    """
    first = parts[0]
    if len(parts) == 1:
        return first
    receivers = [part.num_receivers for part in parts]
    return replace(
        first,
        receivers=joined_indices([part.receivers for part in parts], receivers),
        senders=joined_indices([part.senders for part in parts], [part.num_senders for part in parts]),
        displacements=torch.cat([part.displacements for part in parts]),
        distances=torch.cat([part.distances for part in parts]),
        row_splits=joined_splits([part.row_splits for part in parts]),
        num_senders=sum(part.num_senders for part in parts),
        batch_index=index_of(receivers, first.receivers.device),
    )


def radius_graph(
    positions: Float[Tensor, "M D"],
    cutoff: float,
    box: Box | None = None,
    queries: Float[Tensor, "N D"] | None = None,
    include_self: bool = False,
    batch_index: Int[Tensor, " M"] | None = None,
    query_batch_index: Int[Tensor, " N"] | None = None,
) -> Edges:
    """All pairs within `cutoff`, found in a list of cells on the device of the positions.

    Receivers are the queries (by default the positions themselves), senders the positions. Displacements and distances
    are differentiable with respect to both; which pairs are listed is not. Particles at exactly the same place are
    neighbours of each other.

    Args:
        positions: Sending points (M, D), D from 1 to 3.
        cutoff: Largest distance of a pair, inclusive; at most half the length of every periodic axis.
        box: Domain with its periodic axes; None for open space.
        queries: Receiving points (N, D), e.g. fluid particles that look for boundary points.
        include_self: Whether a particle is its own neighbour; only without `queries`.
        batch_index: Window of each sending point (M,), ascending, where points are those of several windows, which do
            not see each other; None for one window.
        query_batch_index: The same of the receiving points (N,), given exactly if there are `queries`.

    Returns:
        The pairs, sorted by receiver, then sender.

    Raises:
        ShapeError: If shapes or dtypes do not fit or a coordinate is not finite.
        ConfigError: If the cutoff is not positive or exceeds half of a periodic axis, or `include_self` comes with
            `queries`.
    """
    if batch_index is not None or query_batch_index is not None:
        _check_windows(positions, queries, batch_index, query_batch_index)
    receivers_at = positions if queries is None else queries
    _check_points(positions, receivers_at, box)
    _check_cutoff(cutoff, box)
    if include_self and queries is not None:
        raise ConfigError("`include_self` must be False with `queries`: they are other points than `positions`.")
    of_receivers = batch_index if queries is None else query_batch_index
    windows = None if batch_index is None or of_receivers is None else (of_receivers, batch_index)
    search = _compiled_pairs if positions.device.type == "cpu" else _pairs_on_device
    with torch.no_grad():
        row_splits, receivers, senders = search(positions, queries, cutoff, box, include_self, windows)
    displacements, distances = _separations(receivers_at, positions, row_splits, receivers, senders, box)
    return Edges(
        receivers=receivers,
        senders=senders,
        displacements=displacements,
        distances=distances,
        row_splits=row_splits,
        num_senders=len(positions),
        cutoff=float(cutoff),
        bipartite=queries is not None,
        includes_self=include_self,
        batch_index=of_receivers,
    )


def _check_windows(
    positions: Tensor, queries: Tensor | None, batch_index: Tensor | None, query_batch_index: Tensor | None
) -> None:
    if batch_index is None or (queries is None) != (query_batch_index is None):
        raise ShapeError("`batch_index` must come with `positions`, and `query_batch_index` exactly with `queries`.")
    check_batch_index("batch_index", batch_index, len(positions))
    if queries is not None and query_batch_index is not None:
        check_batch_index("query_batch_index", query_batch_index, len(queries))


Windows = tuple[Tensor, Tensor] | None  # batch index of the receivers and of the senders


def _pairs_on_device(
    positions: Tensor, queries: Tensor | None, cutoff: float, box: Box | None, include_self: bool, windows: Windows
) -> tuple[Tensor, Tensor, Tensor]:
    """Splits, receivers and senders of the pairs, by torch operations on the device of the points."""
    dtype = finest_dtype(positions.device)
    senders = from_corner(positions.to(dtype), box)
    receivers = senders if queries is None else from_corner(queries.to(dtype), box)
    lengths, skips_self = _periodic_lengths(positions.shape[1], box).tolist(), queries is None and not include_self
    return tensor_cell_list.pairs_by_receiver(receivers, senders, cutoff, lengths, skips_self, windows)


def _compiled_pairs(
    positions: Tensor, queries: Tensor | None, cutoff: float, box: Box | None, include_self: bool, windows: Windows
) -> tuple[Tensor, Tensor, Tensor]:
    """Splits, receivers and senders of the pairs, by compiled loops window by window."""
    if windows is None:
        return _compiled_pairs_of_window(positions, queries, cutoff, box, include_self)
    count = 1 + max((int(index[-1]) for index in windows if len(index)), default=0)
    of_receivers, of_senders = (counts_of(index, count) for index in windows)
    asked = [None] * count if queries is None else queries.split(of_receivers)
    parts = [
        _compiled_pairs_of_window(*points, cutoff, box, include_self)
        for points in zip(positions.split(of_senders), asked, strict=True)
    ]
    splits, receivers, senders = zip(*parts, strict=True)
    return joined_splits(splits), joined_indices(receivers, of_receivers), joined_indices(senders, of_senders)


def _compiled_pairs_of_window(
    positions: Tensor, queries: Tensor | None, cutoff: float, box: Box | None, include_self: bool
) -> tuple[Tensor, Tensor, Tensor]:
    grid, cells = _sorted_in_cells([positions] if queries is None else [queries, positions], cutoff, box)
    splits, receivers, senders = pairs_by_receiver(cells[0], cells[-1], grid, include_self)
    return torch.from_numpy(splits), torch.from_numpy(receivers), torch.from_numpy(senders)


def half_list(positions: Float[Tensor, "N D"], cutoff: float, box: Box | None = None) -> Int[np.ndarray, "P 2"]:
    """Pairs within `cutoff` without distances, each listed once: (P, 2), in no particular order.

    Arguments and errors are those of `radius_graph`.
    """
    _check_points(positions, positions, box)
    _check_cutoff(cutoff, box)
    grid, (cells,) = _sorted_in_cells([positions], cutoff, box)
    return half_pairs(cells, grid)


def _all_finite(values: Tensor) -> bool:
    # A sum is far cheaper than asking each value, and is finite only if all are.
    return math.isfinite(values.detach().sum().item()) or bool(torch.isfinite(values).all())


def _all_below(indices: Tensor, count: int) -> bool:
    return len(indices) == 0 or 0 <= int(indices.min()) <= int(indices.max()) < count


def _check_points(positions: Tensor, queries: Tensor, box: Box | None) -> None:
    for name, points in (("positions", positions), ("queries", queries)):
        if points.ndim != 2 or not 1 <= points.shape[1] <= 3:
            raise ShapeError(f"`{name}` must have shape (particles, dim) with dim 1 to 3, got {tuple(points.shape)}.")
        if not points.is_floating_point():
            raise ShapeError(f"`{name}` must be floating point, got {points.dtype}.")
        if not _all_finite(points):
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


def _sorted_in_cells(sets: Sequence[Tensor], cutoff: float, box: Box | None) -> tuple[CellGrid, list[Cells]]:
    """Cells of the cutoff around the first of `sets` of points, and each of them sorted by these cells."""
    arrays = [from_corner(points.detach().double(), box).numpy() for points in sets]
    grid = CellGrid.around(arrays[0], cutoff, _periodic_lengths(sets[0].shape[1], box))
    return grid, [grid.sort(points) for points in arrays]


def from_corner(points: Tensor, box: Box | None) -> Tensor:
    """Points brought back into the box along periodic axes and counted from its lower corner, or as they are."""
    if box is None or not any(box.periodic):
        return points.contiguous()
    offset = box.wrap(points) - torch.tensor(box.lower, dtype=points.dtype, device=points.device)
    lengths = torch.tensor(box.lengths, dtype=points.dtype, device=points.device)
    beyond = torch.tensor(box.periodic, device=points.device) & (offset >= lengths)  # by rounding
    return torch.where(beyond, 0.0, offset)


def _periodic_lengths(dim: int, box: Box | None) -> np.ndarray:
    return np.full(dim, np.inf) if box is None else np.where(box.periodic, box.lengths, np.inf)


def _separations(
    to: Tensor, origin: Tensor, row_splits: Tensor, receivers: Tensor, senders: Tensor, box: Box | None
) -> tuple[Tensor, Tensor]:
    """Displacement and distance of each pair, by a compiled loop where nothing is to be differentiated."""
    differentiated = torch.is_grad_enabled() and (to.requires_grad or origin.requires_grad)
    if not differentiated and to.device.type == "cpu" and to.dtype in (torch.float32, torch.float64):
        points = (points.detach().contiguous().numpy() for points in (to, origin))
        lengths = _periodic_lengths(to.shape[1], box).astype(str(to.dtype).removeprefix("torch."))
        found = separations(*points, row_splits.numpy(), senders.numpy(), lengths)
        return torch.from_numpy(found[0]), torch.from_numpy(found[1])
    to, origin = to[receivers], origin[senders]
    displacements = to - origin if box is None else box.displacement(to, origin)
    return displacements, torch.linalg.vector_norm(displacements, dim=1)
