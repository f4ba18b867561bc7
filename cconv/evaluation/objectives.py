"""Objectives: what the models of a task are compared by, in the search, among finalists and in the test."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from cconv.evaluation.metrics import blocks_of_errors, per_frame_normalized_mse
from cconv.models.errors import FrameError, frame_errors, mean_predictor_error, normalized_mse
from cconv.models.model import Model
from cconv.tasks.samples import Sample
from cconv.tasks.task import FieldTask


@dataclass(frozen=True, kw_only=True)
class ErrorTable:
    """Errors of a model on a split; smaller is better.

    Attributes:
        error: Error on the whole split.
        units: Error of each unit that an interval resamples, (units,): trajectories, or blocks of frames.
        per_frame: The thesis's measure, each frame by its own variance; None where a task has none.
    """

    error: float
    units: np.ndarray
    per_frame: float | None


class Objective(ABC):
    """An error that models are compared by.

    Attributes:
        name: Name by which tasks ask for it.
        label: What charts and messages call it.
        meaning: What it is, in sentences for readers.
    """

    name: ClassVar[str]
    label: ClassVar[str]
    meaning: ClassVar[str]

    @abstractmethod
    def error(self, model: Model, samples: Iterable[Sample], geometry: Callable | None = None) -> float:
        """Error of a model on samples.

        Args:
            model: The model.
            samples: Frames with targets.
            geometry: Sample to geometry, e.g. a cache; by default computed afresh.
        """

    @abstractmethod
    def table(self, model: Model, samples: Sequence[Sample], frames_per_block: int) -> ErrorTable:
        """Errors of a model on a split.

        Args:
            model: The model.
            samples: Frames of the split, in order.
            frames_per_block: Frames of a unit where the split has a single trajectory.
        """

    @abstractmethod
    def of_mean_predictor(self, samples: Iterable[Sample], train_samples: Iterable[Sample]) -> float:
        """What a model must be below to know anything: the error of predicting the mean of the training split."""


class NormalizedMSE(Objective):
    """Mean squared error over a split by the variance of the target over the training split."""

    name = "normalized_mse"
    label = "normalized MSE"
    meaning = (
        "Mean squared error divided by the variance of the target over the training split: 0 is perfect. Always "
        "predicting the training mean scores 1 on the training split, more or less on others. Its root is the relative "
        "RMSE."
    )

    def error(self, model: Model, samples: Iterable[Sample], geometry: Callable | None = None) -> float:
        """Error over all particles of the samples; arguments as of `Objective.error`."""
        return normalized_mse(frame_errors(model, samples, geometry))

    def table(self, model: Model, samples: Sequence[Sample], frames_per_block: int) -> ErrorTable:
        """Errors over the split and its units; arguments as of `Objective.table`."""
        frames: list[FrameError] = frame_errors(model, samples)
        return ErrorTable(
            error=normalized_mse(frames),
            units=blocks_of_errors(frames, frames_per_block),
            per_frame=per_frame_normalized_mse(frames),
        )

    def of_mean_predictor(self, samples: Iterable[Sample], train_samples: Iterable[Sample]) -> float:
        """Error of predicting the training mean: 1 on the training split, more where the data move more."""
        return normalized_mse(mean_predictor_error(samples, train_samples))


OBJECTIVES: dict[str, Objective] = {objective.name: objective() for objective in (NormalizedMSE,)}


def objective_of(task: FieldTask) -> Objective:
    """The objective that a task names."""
    return OBJECTIVES[task.objective]
