"""Windows: consecutive frames that a step is predicted from, and those that follow."""

from collections.abc import Iterable, Sequence
from copy import copy
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import torch
from torch import Tensor

from cconv.batching import counts_of, groups_of, index_of
from cconv.data.trajectory import Boundary, Frames, ParticleType
from cconv.devices import moved
from cconv.domain import Box
from cconv.errors import DataError, ShapeError, check_shape


class Origin(NamedTuple):
    """Where a window comes from.

    Attributes:
        trajectory: Name of the trajectory.
        frame: Index of its present in the stored trajectory.
    """

    trajectory: str
    frame: int


@dataclass(frozen=True, kw_only=True)
class Window:
    """Consecutive frames of a trajectory, the last of which is the present; or several such windows, joined.

    The particles of joined windows stand one window after another, those of a window together.

    Attributes:
        positions: The past and the present, (H, N, D), length.
        future: The frames that follow, as far as they are known, (F, N, D).
        masses: (N,).
        particle_types: (N,), int64, values of `ParticleType`.
        boundary: Wall points, or None.
        trajectory: Name of the trajectory, of the first window if several are joined.
        frame: Index of the present in the stored trajectory, of the first window if several are joined.
        batch_index: Window that each particle belongs to, (N,), ascending, if several are joined; None for one.
        joined: Where each of them comes from; empty for one.
    """

    positions: Tensor
    future: Tensor
    masses: Tensor
    particle_types: Tensor
    boundary: Boundary | None
    trajectory: str
    frame: int
    batch_index: Tensor | None = None
    joined: tuple[Origin, ...] = ()

    @property
    def origins(self) -> tuple[Origin, ...]:
        """Where the window comes from, or each of the joined ones."""
        return self.joined or (Origin(self.trajectory, self.frame),)

    @property
    def present(self) -> Tensor:
        """Positions now, (N, D)."""
        return self.positions[-1]

    @property
    def is_fluid(self) -> Tensor:
        """Which particles a model moves, (N,), bool."""
        return self.particle_types == ParticleType.FLUID

    @property
    def device(self) -> torch.device:
        """Where the particles are stored."""
        return self.positions.device

    def to(self, device: torch.device) -> "Window":
        """The same on a device."""
        names = ("positions", "future", "masses", "particle_types", "boundary", "batch_index")
        return moved(self, device, names)

    def ending(self, history: int) -> "Window":
        """The same window without its oldest frames: at most `history` up to the present."""
        return replace(self, positions=self.positions[-history:])

    def displacements(self, box: Box, history: int) -> Tensor:
        """Displacement of each particle from frame to frame of the last `history` ones, (history - 1, N, D), float64.

        Raises:
            ShapeError: If the window has fewer frames.
        """
        if not 2 <= history <= len(self.positions):
            raise ShapeError(
                f"a window must have at least {history} frames up to the present, got {len(self.positions)}."
            )
        last = self.positions[-history:].double()
        return box.displacement(last[1:], last[:-1])

    def last_displacements(self, box: Box) -> Tensor:
        """Displacement of each particle from the frame before the present one, (N, D), float64.

        Raises:
            ShapeError: If there is no frame before it.
        """
        return self.displacements(box, 2)[0]

    def followed_by(self, positions: Tensor) -> "Window":
        """The window a frame later, whose present is `positions` (N, D); as long as this one."""
        past = torch.cat([self.positions[1:], positions[None]])
        joined = tuple(Origin(trajectory, frame + 1) for trajectory, frame in self.joined)
        return replace(self, positions=past, future=self.future[1:], frame=self.frame + 1, joined=joined)

    def separated(self) -> list["Window"]:
        """Return the windows that are joined, or this one alone."""
        if self.batch_index is None:
            return [self]
        counts = counts_of(self.batch_index, len(self.joined))
        boundaries = _separated_boundaries(self.boundary, len(counts))
        parts = zip(
            self.positions.split(counts, dim=1),
            self.future.split(counts, dim=1),
            self.masses.split(counts),
            self.particle_types.split(counts),
            boundaries,
            self.joined,
            strict=True,
        )
        return [
            Window(
                positions=positions,
                future=future,
                masses=masses,
                particle_types=types,
                boundary=boundary,
                trajectory=origin.trajectory,
                frame=origin.frame,
            )
            for positions, future, masses, types, boundary, origin in parts
        ]

    def only(self, kept: Sequence[bool]) -> "Window":
        """Return some of the windows that are joined, at least one.

        Args:
            kept: Whether each of them is kept.
        """
        if all(kept):
            return self
        return join_windows([window for window, keep in zip(self.separated(), kept, strict=True) if keep])


def join_windows(windows: Sequence[Window]) -> Window:
    """Join windows of a group of `joinable`, at least one, so that they are asked about together."""
    first = windows[0]
    if len(windows) == 1:
        return first
    return replace(
        first,
        positions=torch.cat([window.positions for window in windows], dim=1),
        future=torch.cat([window.future for window in windows], dim=1),
        masses=torch.cat([window.masses for window in windows]),
        particle_types=torch.cat([window.particle_types for window in windows]),
        boundary=_joined_boundaries([window.boundary for window in windows if window.boundary is not None]),
        batch_index=index_of([len(window.masses) for window in windows], first.device),
        joined=tuple(origin for window in windows for origin in window.origins),
    )


def joinable(windows: Sequence[Window]) -> list[list[int]]:
    """Groups of the numbers of windows to join: alike in frames and in walls, with not too many particles together."""
    return groups_of([len(window.masses) for window in windows], [_kind(window) for window in windows])


def _kind(window: Window) -> tuple:
    walls = window.boundary is not None, window.boundary is not None and window.boundary.normals is not None
    frames = len(window.positions), len(window.future), window.positions.dtype, window.future.dtype
    return *frames, *walls, bool(window.is_fluid.all())


def _joined_boundaries(boundaries: Sequence[Boundary]) -> Boundary | None:
    """Walls of all windows, None where there are none."""
    if not boundaries:
        return None
    normals = [boundary.normals for boundary in boundaries if boundary.normals is not None]
    return Boundary(
        positions=torch.cat([boundary.positions for boundary in boundaries]),
        normals=torch.cat(normals) if normals else None,
        batch_index=index_of([len(each.positions) for each in boundaries], boundaries[0].positions.device),
    )


def _separated_boundaries(boundary: Boundary | None, windows: int) -> Sequence[Boundary | None]:
    """Walls of each of so many windows."""
    if boundary is None or boundary.batch_index is None:
        return [boundary] * windows
    counts = counts_of(boundary.batch_index, windows)
    normals = [None] * windows if boundary.normals is None else boundary.normals.split(counts)
    parts = zip(boundary.positions.split(counts), normals, strict=True)
    return [Boundary(positions=positions, normals=some) for positions, some in parts]


def window_at(trajectory: Frames, present: int, history: int, future: int) -> Window:
    """The window of a trajectory whose present is one of its frames.

    Args:
        trajectory: The trajectory.
        present: Index of the present, counted from the trajectory's first frame here.
        history: Frames up to the present, H.
        future: Frames after it, F.

    Raises:
        DataError: If the trajectory does not have all these frames.
    """
    check_window(trajectory.name, len(trajectory), present, history, future)
    frames = trajectory.between(present - history + 1, present + 1 + future)
    return Window(
        positions=frames.positions[:history],
        future=frames.positions[history:],
        masses=frames.masses,
        particle_types=frames.particle_types,
        boundary=frames.boundary,
        trajectory=trajectory.name,
        frame=trajectory.first_frame + present,
    )


def window_from_arrays(
    positions: Any, masses: Any, particle_types: Any = None, boundary: Boundary | None = None
) -> Window:
    """The window of frames that another program holds, to ask a model of a step about.

    Args:
        positions: The past and the present, oldest first, (H, N, D), length.
        masses: (N,).
        particle_types: Values of `ParticleType`, (N,); None if all particles are fluid.
        boundary: Wall points, or None.

    Raises:
        ShapeError: If shapes do not fit, or a position is not finite.
    """
    positions, masses = torch.as_tensor(positions), torch.as_tensor(masses)
    if positions.ndim != 3:
        raise ShapeError(f"`positions` must have shape (frames, particles, dim), got {tuple(positions.shape)}.")
    if not torch.isfinite(positions).all():
        raise ShapeError("`positions` must be finite, got NaN or infinity; look for a simulation that blew up.")
    _, particles, _ = positions.shape
    types = torch.zeros(particles, dtype=torch.int64) if particle_types is None else torch.as_tensor(particle_types)
    check_shape("masses", masses.shape, (particles,))
    check_shape("particle_types", types.shape, (particles,))
    return Window(
        positions=positions,
        future=positions[:0],
        masses=masses,
        particle_types=types.long(),
        boundary=boundary,
        trajectory="arrays",
        frame=len(positions) - 1,
    )


def check_window(trajectory: str, frames: int, present: int, history: int, future: int) -> None:
    """Check that a trajectory of so many frames has a window; arguments as of `window_at`.

    Raises:
        DataError: If it does not have all its frames.
    """
    first, stop = present - history + 1, present + 1 + future
    if not 0 <= first < stop <= frames:
        raise DataError(
            f"trajectory {trajectory}: has {frames} frames, and a window of {history} up to frame {present} and "
            f"{future} after it needs frames {first} to {stop - 1}; ask for fewer or another start."
        )


def check_length(trajectory: str, frames: int, history: int, future: int) -> None:
    """Check that a trajectory of so many frames has a window.

    Raises:
        DataError: If it is too short.
    """
    if frames == 1:
        raise DataError(
            f"trajectory {trajectory}: has a single frame, and a step leads to the next one; store frames at one "
            "interval (cconv data import without --separate-frames), or ask for a field."
        )
    if frames < history + future:
        raise DataError(
            f"trajectory {trajectory}: has {frames} frames, too few for a window of {history} and {future} after it; "
            "lower the history or the horizon, or store more frames."
        )


class Windows(Sequence[Window]):
    """All windows of some trajectories, or every one at a stride, each cut out or read when it is asked for.

    They share frames of trajectories that are in memory, also when they are sent to another process. LagrangeBench's
    test windows do not overlap: their stride is ``history + future``.

    Args:
        trajectories: The trajectories.
        history: Frames up to the present, H.
        future: Frames after it, F.
        stride: Frames from one present to the next.
        further: Frames after those, as many as are stored.

    Raises:
        DataError: If a trajectory is too short for a single one.
    """

    def __init__(self, trajectories: Iterable[Frames], history: int, future: int, stride: int = 1, further: int = 0):
        self._trajectories = list(trajectories)
        self._history, self._future, self._further = history, future, further
        self._places = [
            (number, present)
            for number, trajectory in enumerate(self._trajectories)
            for present in self._presents(trajectory, stride)
        ]

    def _presents(self, trajectory: Frames, stride: int) -> range:
        check_length(trajectory.name, len(trajectory), self._history, self._future)
        return range(self._history - 1, len(trajectory) - self._future, stride)

    def __len__(self) -> int:
        return len(self._places)

    def __getitem__(self, index: Any) -> Any:
        if isinstance(index, slice):
            some = copy(self)
            some._places = self._places[index]
            return some
        number, present = self._places[index]
        trajectory = self._trajectories[number]
        future = min(self._future + self._further, len(trajectory) - present - 1)
        return window_at(trajectory, present, self._history, future)
