"""LagrangeBench folders that grow a frame at a time, and keep the frames so far whatever ends them."""

import os
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from pathlib import Path

import h5py
import torch
from torch import Tensor

from cconv.data.folders import whole_folder
from cconv.data.hdf5 import Summary, write_constants, write_metadata
from cconv.data.source import SPLITS
from cconv.data.stored_frames import FRAMES_OF_A_PIECE
from cconv.data.trajectory import ParticleType, Scene, Trajectory
from cconv.errors import ConfigError

OVERHEAD = 2**16  # bytes that HDF5 may write beside the values of a frame
ROOM = 2**18  # bytes kept free for what is written at the end, where the disk is full


class GrowingDataset:
    """A folder with one trajectory a split, whose positions are appended frame by frame; see `growing_dataset`.

    Attributes:
        count: Frames that were appended after the first ones.
    """

    def __init__(self, folder: Path, scene: Scene, begun: Trajectory, stack: ExitStack):
        self.count = 0
        self._folder, self._scene, self._room = folder, scene, folder / "room"
        self._room.write_bytes(bytes(ROOM))
        self._files = {split: _GrowingFile(folder / f"{split}.h5", begun, scene) for split in SPLITS}
        for file in self._files.values():
            stack.callback(file.close)
        for frame in begun.positions:
            self._append(dict.fromkeys(SPLITS, frame))
        self._begun = len(begun)

    def append(self, positions: Mapping[str, Tensor]) -> None:
        """Append a frame (N, D) to the trajectory of each split.

        Raises:
            OSError: If there is no room for it; the frames before it are whole.
        """
        self._append(positions)
        self.count += 1

    def _append(self, positions: Mapping[str, Tensor]) -> None:
        for file in self._files.values():
            file.reserve()
        for split, file in self._files.items():
            file.append(positions[split])

    def finish(self, metadata: Mapping) -> None:
        """Drop what was half appended, and write metadata.json with further keys."""
        self._room.unlink()
        summaries = {split: file.cut(self._begun + self.count) for split, file in self._files.items()}
        write_metadata(self._folder, self._scene, metadata, summaries)


@contextmanager
def growing_dataset(folder: Path, scene: Scene, begun: Trajectory, metadata: Mapping) -> Iterator[GrowingDataset]:
    """Give a folder in the LagrangeBench layout that grows under a temporary name beside `folder`.

    It gets its name at the end, also where an exception ends the block, such as Ctrl-C or a full disk, if a frame was
    appended by then; else nothing is left.

    Args:
        folder: Where to write; it must be missing or empty.
        scene: What the trajectories share; velocities are not written.
        begun: Frames that the trajectories of all splits begin with, with their types, masses and walls.
        metadata: Further keys of metadata.json.

    Raises:
        ConfigError: If the folder exists and is not empty, or cannot be written; with the number of frames that were
            kept, if there was no room for the next one.
    """
    ended: BaseException | None = None
    with whole_folder(folder, (), overwrite=False) as partial, ExitStack() as stack:
        growing = GrowingDataset(partial, scene, begun, stack)
        try:
            yield growing
        except BaseException as error:
            if growing.count == 0:
                raise
            ended = error
        growing.finish(metadata)
    if isinstance(ended, OSError):
        raise ConfigError(
            f"{folder}: cannot be written any further ({ended.strerror or ended}); the {growing.count} frames so far "
            "are kept: make room, then ask again for more."
        ) from ended
    if ended is not None:
        raise ended


class _GrowingFile:
    """An HDF5 file with one trajectory, which can be closed and read however far it came.

    HDF5 loses a file whose disk is full when it writes. So the bytes after its end are taken before each frame, and
    given back at the end.
    """

    def __init__(self, path: Path, begun: Trajectory, scene: Scene):
        first = begun.positions[0].numpy()
        self._path, self._ahead = path, bytes(first.nbytes + OVERHEAD)
        self._box, self._is_fluid = scene.box, begun.particle_types == ParticleType.FLUID
        path.write_bytes(self._ahead)
        self._file = h5py.File(path, "w")
        group = self._file.create_group("00000")
        settings = {"dtype": first.dtype, "compression": "gzip", "track_times": False}
        self._positions = group.create_dataset(
            "position", shape=(0, *first.shape), maxshape=(None, *first.shape), chunks=(1, *first.shape), **settings
        )
        write_constants(group, begun, scene)
        self._file.flush()

    def reserve(self) -> None:
        """Take the bytes that the next frame needs.

        Raises:
            OSError: If they cannot be had.
        """
        with self._path.open("r+b") as file:
            file.seek(self._file.id.get_filesize())
            file.write(self._ahead)

    def append(self, positions: Tensor) -> None:
        """Append a frame (N, D)."""
        with _one_kind_of_errors():
            count = len(self._positions)
            self._positions.resize(count + 1, axis=0)
            self._positions[count] = positions.cpu().numpy()
            self._file.flush()

    def cut(self, count: int) -> Summary:
        """Keep the first `count` frames, and close the file; give their statistics."""
        with _one_kind_of_errors():
            self._positions.resize(count, axis=0)
            self._file.flush()
        os.truncate(self._path, self._file.id.get_filesize())
        summary = Summary(self._box)
        for begins in range(0, count, FRAMES_OF_A_PIECE):
            piece = torch.from_numpy(self._positions[begins : begins + FRAMES_OF_A_PIECE + 2])
            summary.add_steps(piece[:, self._is_fluid], FRAMES_OF_A_PIECE)
        summary.add_length(count, len(self._is_fluid))
        self.close()
        return summary

    def close(self) -> None:
        """Close the file as it is."""
        with _one_kind_of_errors():
            self._file.close()


@contextmanager
def _one_kind_of_errors() -> Iterator[None]:
    """Raise `OSError` also where h5py raises another error for what the system refuses."""
    try:
        yield
    except RuntimeError as error:
        raise OSError(str(error)) from error
