"""The interface of logs that others read, such as TensorBoard's: evaluations of a training as they are made."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol


@dataclass(frozen=True, kw_only=True)
class Training:
    """The training that a log is of.

    Attributes:
        folder: Its folder.
        study: Name of its study.
        stage: Stage of the study that it belongs to.
        settings: Its configuration, JSON values.
        begun: When it began, in seconds since 1970, as if it had never paused.
    """

    folder: Path
    study: str
    stage: str
    settings: Mapping[str, Any]
    begun: float

    @property
    def run(self) -> Path:
        """Folder of the run that the training is a part of; its own where it is a part of none."""
        return next((each for each in self.folder.parents if (each / "study.json").is_file()), self.folder)

    @property
    def name(self) -> str:
        """Name of the training in its run."""
        return self.folder.name if self.run == self.folder else self.folder.relative_to(self.run).as_posix()


@dataclass(frozen=True, kw_only=True)
class Evaluation:
    """What an evaluation of a training found.

    Attributes:
        updates: Updates so far.
        seconds: Seconds of training so far.
        values: Finite values by name.
    """

    updates: int
    seconds: float
    values: Mapping[str, float]


class TrainingLog(Protocol):
    """A log of a training for another program; made of a `Training`, it is empty at first."""

    def write(self, evaluation: Evaluation) -> None:
        """Add an evaluation."""

    def close(self) -> None:
        """Bring the log to its end."""
