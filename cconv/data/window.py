"""Windows: consecutive frames that a step is predicted from, and those that follow."""

from collections.abc import Iterable, Sequence
from copy import copy
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from cconv.data.trajectory import Boundary, ParticleType, Trajectory
from cconv.domain import Box
from cconv.errors import DataError, ShapeError


@dataclass(frozen=True, kw_only=True)
class Window:
    """Consecutive frames of a trajectory, the last of which is the present.

    Attributes:
        positions: The past and the present, (H, N, D), length.
        future: The frames that follow, as far as they are known, (F, N, D).
        masses: (N,).
        particle_types: (N,), int64, values of `ParticleType`.
        boundary: Wall points, or None.
        trajectory: Name of the trajectory.
        frame: Index of the present in the stored trajectory.
    """

    positions: Tensor
    future: Tensor
    masses: Tensor
    particle_types: Tensor
    boundary: Boundary | None
    trajectory: str
    frame: int

    @property
    def present(self) -> Tensor:
        """Positions now, (N, D)."""
        return self.positions[-1]

    @property
    def is_fluid(self) -> Tensor:
        """Which particles a model moves, (N,), bool."""
        return self.particle_types == ParticleType.FLUID

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
        return replace(self, positions=past, future=self.future[1:], frame=self.frame + 1)


def window_at(trajectory: Trajectory, present: int, history: int, future: int) -> Window:
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
    first, stop = present - history + 1, present + 1 + future
    return Window(
        positions=trajectory.positions[first : present + 1],
        future=trajectory.positions[present + 1 : stop],
        masses=trajectory.masses,
        particle_types=trajectory.particle_types,
        boundary=trajectory.boundary,
        trajectory=trajectory.name,
        frame=trajectory.first_frame + present,
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
    if frames < history + future:
        raise DataError(
            f"trajectory {trajectory}: has {frames} frames, too few for a window of {history} and {future} after it; "
            "lower the history or the horizon, or store more frames."
        )


class Windows(Sequence[Window]):
    """All windows of some trajectories, or every one at a stride, each cut out when it is asked for.

    They share the frames of the trajectories, in memory and when they are sent to another process. LagrangeBench's test
    windows do not overlap: their stride is ``history + future``.

    Args:
        trajectories: The trajectories.
        history: Frames up to the present, H.
        future: Frames after it, F.
        stride: Frames from one present to the next.
        further: Frames after those, as many as are stored.

    Raises:
        DataError: If a trajectory is too short for a single one.
    """

    def __init__(
        self, trajectories: Iterable[Trajectory], history: int, future: int, stride: int = 1, further: int = 0
    ):
        self._trajectories = list(trajectories)
        self._history, self._future, self._further = history, future, further
        self._places = [
            (number, present)
            for number, trajectory in enumerate(self._trajectories)
            for present in self._presents(trajectory, stride)
        ]

    def _presents(self, trajectory: Trajectory, stride: int) -> range:
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
