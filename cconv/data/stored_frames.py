"""Frames of a trajectory that are read in pieces when they are asked for, so that memory does not grow with them."""

from collections.abc import Iterator
from functools import cached_property
from typing import Any

from torch import Tensor

from cconv.data.dataset import Dataset
from cconv.data.trajectory import Boundary, Frame, Frames, Trajectory

FRAMES_OF_A_PIECE = 64
PIECE_BYTES = 2**26  # of positions and velocities of a piece, unless a single frame has more
KEPT_BYTES = 2**31  # of the trajectories of a split that stay in memory


class StoredFrames:
    """Consecutive frames of a block of a data set; the last piece that was read is kept.

    Velocities are those that the whole trajectory has: pieces are read with a frame more at each end, which central
    differences need.

    Args:
        dataset: The data set.
        split: "train", "valid" or "test".
        k: Index of the block in the split.
        first_frame: Index of the first frame within the trajectory that they belong to; None for that of the block.

    Raises:
        DataError: If there is no such split or block, or the files are damaged.
    """

    def __init__(self, dataset: Dataset, split: str, k: int, first_frame: int | None = None):
        self._source, self._block = dataset.source, dataset.block(split, k)
        self._length = dataset.num_frames(self._block)
        self.name = self._block.trajectory
        self.first_frame = self._block.start if first_frame is None else first_frame
        self._begins: int | None = None
        self._piece = self._first

    def __getstate__(self) -> dict[str, Any]:
        """Everything but the piece in memory, which another process reads again."""
        kept = {name: value for name, value in vars(self).items() if name != "_piece"}
        return kept | {"_begins": None, "_piece": self._first}

    @cached_property
    def _first(self) -> Trajectory:
        """The first frame."""
        return self.between(0, 1)

    @property
    def particle_types(self) -> Tensor:
        """Types of the particles, (N,), int64."""
        return self._first.particle_types

    @property
    def boundary(self) -> Boundary | None:
        """Wall points of all frames, or None."""
        return self._first.boundary

    @property
    def bytes_of_a_frame(self) -> int:
        """Memory of positions and velocities of a frame."""
        return self._first.positions.nbytes + self._first.velocities.nbytes

    @property
    def nbytes(self) -> int:
        """Memory that positions and velocities of all frames would take."""
        return self._length * self.bytes_of_a_frame

    @property
    def frames_of_a_piece(self) -> int:
        """Number of frames that are read together."""
        return max(1, min(FRAMES_OF_A_PIECE, PIECE_BYTES // self.bytes_of_a_frame))

    def __len__(self) -> int:
        return self._length

    def __getitem__(self, index: int) -> Frame:
        if not 0 <= index < self._length:
            raise IndexError(index)
        begins = index - index % self.frames_of_a_piece
        if begins != self._begins:
            stop = min(self._length, begins + self.frames_of_a_piece + 1)
            self._piece, self._begins = self.between(max(0, begins - 1), stop), begins
        return self._piece[index - max(0, begins - 1)]

    def between(self, start: int, stop: int) -> Trajectory:
        """Read some of the frames, from `start` up to `stop`, counted from the first one here."""
        return self._source.read(self._block.trajectory, self._block.start + start, self._block.start + stop)

    def pieces(self) -> Iterator[Trajectory]:
        """Read all frames, so many at a time as are read together, each piece with the first frame of the next."""
        for begins in range(0, self._length, self.frames_of_a_piece):
            yield self.between(begins, min(self._length, begins + self.frames_of_a_piece + 1))


def kept_trajectories(dataset: Dataset, split: str, most_bytes: int = KEPT_BYTES) -> list[Frames]:
    """The blocks of a split: in memory as far as there is room for them, the others read when they are asked for.

    Args:
        dataset: The data set.
        split: "train", "valid" or "test".
        most_bytes: Memory for all that stay there.
    """
    found: list[Frames] = []
    for k in range(len(dataset.splits[split])):
        stored = StoredFrames(dataset, split, k)
        fits = stored.nbytes <= most_bytes
        most_bytes -= stored.nbytes if fits else 0
        found.append(dataset.trajectory(split, k) if fits else stored)
    return found
