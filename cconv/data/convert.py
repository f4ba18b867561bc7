"""Conversion of any data set to the LagrangeBench layout with our extra members."""

from collections.abc import Callable, Iterable, Iterator
from pathlib import Path

from cconv.data.dataset import Dataset
from cconv.data.hdf5 import write_splits
from cconv.data.trajectory import Trajectory


def convert(
    dataset: Dataset,
    folder: str | Path,
    overwrite: bool = False,
    progress: Callable[[Iterable, str], Iterable] = lambda items, label: items,
) -> None:
    """Write a data set in the LagrangeBench layout with our extras.

    Each split becomes a file and each of its blocks a trajectory. The scene, the values given by the user and the list
    of missing facts are kept.

    Args:
        dataset: The data set to write.
        folder: Folder to write.
        overwrite: Whether an older data set in `folder` may be replaced.
        progress: Wraps the trajectories of a split to show progress, given a label.

    Raises:
        ConfigError: If the folder exists and must not be replaced.
        DataError: If the data cannot be read.
    """
    splits = {split: progress(_SplitReader(dataset, split), split) for split in dataset.splits}
    write_splits(Path(folder), dataset.scene, splits, dataset.metadata, overwrite)


class _SplitReader:
    """Trajectories of a split, read one at a time when asked for; knows their number, for progress."""

    def __init__(self, dataset: Dataset, split: str):
        self._dataset, self._split = dataset, split

    def __len__(self) -> int:
        return len(self._dataset.splits[self._split])

    def __iter__(self) -> Iterator[Trajectory]:
        return self._dataset.trajectories(self._split)
