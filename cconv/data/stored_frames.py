"""Frames of a trajectory that are read in pieces when they are asked for, so that memory does not grow with them."""

from torch import Tensor

from cconv.data.dataset import Dataset
from cconv.data.trajectory import Boundary, Frame, Trajectory

FRAMES_OF_A_PIECE = 64


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
        self._piece = self._read(0)
        self._begins = 0

    @property
    def particle_types(self) -> Tensor:
        """Types of the particles, (N,), int64."""
        return self._piece.particle_types

    @property
    def boundary(self) -> Boundary | None:
        """Wall points of all frames, or None."""
        return self._piece.boundary

    def __len__(self) -> int:
        return self._length

    def __getitem__(self, index: int) -> Frame:
        if not 0 <= index < self._length:
            raise IndexError(index)
        begins = index - index % FRAMES_OF_A_PIECE
        if begins != self._begins:
            self._piece, self._begins = self._read(begins), begins
        return self._piece[index - max(0, begins - 1)]

    def between(self, start: int, stop: int) -> Trajectory:
        """Read some of the frames, from `start` up to `stop`, counted from the first one here."""
        return self._source.read(self._block.trajectory, self._block.start + start, self._block.start + stop)

    def _read(self, begins: int) -> Trajectory:
        return self.between(max(0, begins - 1), min(self._length, begins + FRAMES_OF_A_PIECE + 1))
