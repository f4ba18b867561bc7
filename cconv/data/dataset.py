"""The data set: a scene, splits, and trajectories that are read when they are asked for."""

import hashlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from cconv.data.deep_lagrangian_fluids import SUFFIX, DeepLagrangianFluidsSource, holds_records
from cconv.data.hdf5 import FILES, LagrangeBenchSource, holds_hdf5
from cconv.data.source import SPLITS, Given, TrajectorySource
from cconv.data.splits import Block, checked_fractions, split_names
from cconv.data.trajectory import Scene, Trajectory
from cconv.errors import DataError, did_you_mean


@dataclass(frozen=True, kw_only=True)
class Dataset:
    """Particle data of one scene, split for training.

    Attributes:
        path: Folder of the data.
        format: "LagrangeBench" or "DeepLagrangianFluids".
        scene: Facts that all trajectories share.
        splits: Blocks of "train", "valid" and "test".
        metadata: Further stored facts about the data.
        source: Reads the files.
    """

    path: Path
    format: str
    scene: Scene
    splits: dict[str, tuple[Block, ...]]
    metadata: dict
    source: TrajectorySource

    def trajectory(self, split: str, k: int) -> Trajectory:
        """Read block `k` of a split from its files.

        Raises:
            DataError: If there is no such split or block, or the files are damaged.
        """
        return self.source.read(*self.block(split, k))

    def block(self, split: str, k: int) -> Block:
        """Return where block `k` of a split lies, without reading it.

        Raises:
            DataError: If there is no such split or block.
        """
        if split not in self.splits:
            raise DataError(
                f"{self.path}: has no split {split!r}; it has {', '.join(self.splits)}."
                + did_you_mean(split, self.splits)
            )
        blocks = self.splits[split]
        if not 0 <= k < len(blocks):
            raise DataError(f"{self.path}: split {split!r} has {len(blocks)} trajectories, counted from 0; got {k}.")
        return blocks[k]

    def trajectories(self, split: str) -> Iterator[Trajectory]:
        """Yield all blocks of a split, one at a time."""
        return (self.trajectory(split, k) for k in range(len(self.splits[split])))

    def frames(self, split: str) -> Iterator[tuple[Trajectory, int]]:
        """Every frame of a split as (trajectory, index of the frame in it)."""
        for trajectory in self.trajectories(split):
            for index in range(len(trajectory)):
                yield trajectory, index

    def num_frames(self, block: Block) -> int:
        """Number of frames of a block."""
        stop = self.source.num_frames(block.trajectory) if block.stop is None else block.stop
        return stop - block.start

    def fingerprint(self) -> str:
        """SHA-256 over names and bytes of the data files, in hexadecimal; the same wherever the folder is."""
        digest = hashlib.sha256()
        for file in self.source.files:
            with file.open("rb") as stream:
                content = hashlib.file_digest(stream, "sha256").hexdigest()
            digest.update(f"{file.relative_to(self.path).as_posix()} {content}\n".encode())
        return digest.hexdigest()


def open_dataset(
    path: str | Path,
    *,
    mass: float | None = None,
    particle_spacing: float | None = None,
    frame_dt: float | None = None,
    force: Sequence[float] | None = None,
    split_fractions: Sequence[float] = (0.7, 0.15, 0.15),
    gap: int = 2,
    data_seed: int = 0,
) -> Dataset:
    """Open a LagrangeBench folder, one of our own or a DeepLagrangianFluids folder.

    Splits that files or folders store are kept. Otherwise trajectories are split by a seeded permutation; a single
    trajectory is cut into consecutive blocks of time. Nothing beside the data is ever run.

    Args:
        path: Folder of the data.
        mass: Mass of every particle; None takes the value of the data, as for the next three arguments.
        particle_spacing: Initial distance of neighbouring particles, dx.
        frame_dt: Time between stored frames.
        force: Constant external acceleration, D numbers.
        split_fractions: Shares of train, valid and test where no split is stored.
        gap: Frames dropped between blocks of a single trajectory, so that neighbours in time are not in two splits.
        data_seed: Seed of the permutation of trajectories.

    Returns:
        The data set; trajectories are read when asked for.

    Raises:
        DataError: If the folder is missing, not known, damaged or too small to split.
        ConfigError: If a setting cannot be.
    """
    folder = Path(path)
    fractions = checked_fractions(split_fractions, gap)
    given = Given(
        mass=mass, particle_spacing=particle_spacing, frame_dt=frame_dt, force=None if force is None else tuple(force)
    )
    source = _source(folder, given)
    scene = source.scene
    if source.stored_splits and "test" not in source.stored_splits:
        line = "test split: not stored; taken from the validation split, whose other part is for validation"
        scene = replace(scene, missing=(*scene.missing, line))
    return Dataset(
        path=folder,
        format=source.format,
        scene=scene,
        splits=_splits(source, fractions, gap, data_seed, folder),
        metadata=source.metadata,
        source=source,
    )


def _source(folder: Path, given: Given) -> TrajectorySource:
    if not folder.exists():
        raise DataError(f"{folder}: does not exist; name the folder of the data.")
    if not folder.is_dir():
        raise DataError(f"{folder}: is a file; name the folder that holds it.")
    if holds_hdf5(folder):
        return LagrangeBenchSource(folder, given)
    if holds_records(folder):
        return DeepLagrangianFluidsSource(folder, given)
    raise DataError(
        f"{folder}: has no particle data; looked for {', '.join(FILES)} (LagrangeBench) and "
        f"*{SUFFIX} here or in train/, valid/, test/ (DeepLagrangianFluids)."
    )


def _splits(
    source: TrajectorySource, fractions: tuple[float, ...], gap: int, seed: int, folder: Path
) -> dict[str, tuple[Block, ...]]:
    stored = {split: tuple(Block(name, 0, None) for name in names) for split, names in source.stored_splits.items()}
    if set(stored) == set(SPLITS):
        return stored
    if stored:
        # Published DeepLagrangianFluids sets have no test split: a part of the validation split becomes the test split.
        valid, test = split_names(source.stored_splits["valid"], source.num_frames, fractions[1:], gap, seed, folder)
        return {"train": stored["train"], "valid": valid, "test": test}
    blocks = split_names(source.names, source.num_frames, fractions, gap, seed, folder)
    return dict(zip(SPLITS, blocks, strict=True))
