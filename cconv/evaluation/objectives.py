"""Objectives: the error that compares the models of a task in the search, among finalists and in the test."""

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import torch

from cconv.evaluation.metrics import blocks_of_errors, own_variance, per_frame_normalized_mse
from cconv.evaluation.rollout_errors import RolloutErrors, constant_rollouts, rollouts_of
from cconv.models.errors import frame_errors, mean_predictor_error, normalized_mse
from cconv.models.model import Model
from cconv.tasks.samples import Sample
from cconv.tasks.task import Task


@dataclass(frozen=True, kw_only=True)
class ErrorTable:
    """Errors of a model on a split; smaller is better.

    Attributes:
        error: Error on the whole split.
        units: Error of each unit that an interval resamples, (units,): trajectories, or blocks of frames.
        measures: Further measures by the names that the objective gives them; None where one is not defined.
    """

    error: float
    units: np.ndarray
    measures: dict[str, float | None]


class Objective(ABC):
    """An error that models are compared by.

    Attributes:
        name: Name by which tasks refer to it.
        label: Name in charts and messages.
        meaning: Explanation in sentences for readers.
        measures: Further measures: the name of each, and its explanation in a sentence. The first is printed beside
            the error.
        mean_predictor: Explanation of the error of always predicting the mean, a sentence.
    """

    name: ClassVar[str]
    label: ClassVar[str]
    meaning: ClassVar[str]
    measures: ClassVar[dict[str, str]] = {}
    mean_predictor: ClassVar[str]

    @abstractmethod
    def error(self, model: Model, samples: Iterable[Sample], geometry: Callable | None = None) -> float:
        """Error of a model on samples.

        Args:
            model: The model.
            samples: Frames with targets.
            geometry: Function from a sample to its geometry, e.g. a cache; by default it is computed anew.
        """

    @abstractmethod
    def table(self, model: Model, samples: Iterable[Sample], frames_per_block: int) -> ErrorTable:
        """Errors of a model on a split.

        Args:
            model: The model.
            samples: Frames of the split, in order; they are read once.
            frames_per_block: Frames of a unit if the split has a single trajectory.
        """

    @abstractmethod
    def in_words(self, error: float) -> str:
        """Explain the size of an error, as the end of a sentence."""

    @abstractmethod
    def own_error(self, error: float, model: Model, samples: Iterable[Sample]) -> float | None:
        """Error relative to the variance of the samples themselves; None where that is not defined.

        Args:
            error: Error of the model on the samples.
            model: The model.
            samples: The samples.
        """

    @abstractmethod
    def of_mean_predictor(self, samples: Iterable[Sample], train_samples: Iterable[Sample]) -> float:
        """Return the error of predicting the mean of the training split; a useful model is well below it."""


class NormalizedMSE(Objective):
    """Mean squared error over a split ÷ variance of the target over the training split."""

    name = "normalized_mse"
    label = "normalized MSE"
    meaning = (
        "Mean squared error divided by the variance of the target over the training split: 0 is perfect. Always "
        "predicting the training mean scores 1 on the training split, more or less on others."
    )
    measures = {
        "relative RMSE": "The relative RMSE is the root of the normalized MSE.",
        "per-frame normalized MSE": "The per-frame normalized MSE divides by each frame's own variance, as the thesis "
        "did, and serves only to compare with it.",
    }
    mean_predictor = "It is above 1 on a split that varies more than the training split, and below 1 on a calmer one."

    def error(self, model: Model, samples: Iterable[Sample], geometry: Callable | None = None) -> float:
        """Error over all particles of the samples; arguments as of `Objective.error`."""
        return normalized_mse(frame_errors(model, samples, geometry))

    def table(self, model: Model, samples: Iterable[Sample], frames_per_block: int) -> ErrorTable:
        """Errors over the split and its units; arguments as of `Objective.table`."""
        frames = frame_errors(model, samples)
        error = normalized_mse(frames)
        return ErrorTable(
            error=error,
            units=blocks_of_errors(frames, frames_per_block),
            measures={
                "relative RMSE": math.sqrt(error),
                "per-frame normalized MSE": per_frame_normalized_mse(frames),
            },
        )

    def in_words(self, error: float) -> str:
        """Express the error of a typical particle as a share of the spread of the target."""
        return (
            f"a typical error of {100 * math.sqrt(error):.3g} % of the spread of the true values in the training data"
        )

    def own_error(self, error: float, model: Model, samples: Iterable[Sample]) -> float | None:
        """Divide by the variance of the samples instead of that of the training split; None if they are constant."""
        variance = own_variance(model, samples)
        return error / variance if variance > 0 else None

    def of_mean_predictor(self, samples: Iterable[Sample], train_samples: Iterable[Sample]) -> float:
        """Return the error of predicting the training mean: 1 on the training split, more where the data vary more."""
        return normalized_mse(mean_predictor_error(samples, train_samples))


class RolloutMSE(Objective):
    """Mean squared error of the positions of rollouts, over their frames, particles and components."""

    name = "rollout_mse"
    label = "rollout MSE"
    meaning = (
        "Mean squared error of the positions while the model is rolled out by its own answers, over all frames of the "
        "rollouts, particles and components, in squared lengths of the data (LagrangeBench's MSE_n). A frame that a "
        "rollout does not reach, because it diverged, and one that is farther off, count as the error of half the box."
    )
    measures = {
        "first-frame MSE": "The first-frame MSE is that of the first frame of each rollout, the error of a single "
        "step, which says little about stability.",
        "MSE5": "MSE5 is that of the first five frames, as LagrangeBench reports it beside MSE20.",
        "diverged rollouts": "Diverged rollouts are the share of rollouts that did not reach their last frame.",
    }
    mean_predictor = "All particles then get the same acceleration, so that they go on nearly at a constant velocity."

    def error(self, model: Model, samples: Iterable[Sample], geometry: Callable | None = None) -> float:
        """Error over all rollouts; arguments as of `Objective.error`."""
        return float(np.mean([rolled.error for rolled in rollouts_of(model, samples)]))

    def table(self, model: Model, samples: Iterable[Sample], frames_per_block: int) -> ErrorTable:
        """Errors over the rollouts; a unit is a trajectory, or a rollout if there is one trajectory alone."""
        rolled = rollouts_of(model, samples)
        names = [each.trajectory for each in rolled]
        errors = np.array([each.error for each in rolled])
        groups = [[name == each for each in names] for name in dict.fromkeys(names)]
        return ErrorTable(
            error=float(errors.mean()),
            units=np.array([errors[group].mean() for group in groups]) if len(groups) > 1 else errors,
            measures={
                "first-frame MSE": float(np.mean([each.errors[0] for each in rolled])),
                "MSE5": _mean_of_first(5, rolled),
                "diverged rollouts": float(np.mean([each.diverged is not None for each in rolled])),
            },
        )

    def in_words(self, error: float) -> str:
        """Express the error as a distance."""
        return f"a typical distance of {math.sqrt(error):.3g} from the true position along each axis"

    def own_error(self, error: float, model: Model, samples: Iterable[Sample]) -> float | None:
        """Return None: the error is a squared distance, relative to no variance."""
        return None

    def of_mean_predictor(self, samples: Iterable[Sample], train_samples: Iterable[Sample]) -> float:
        """Return the error of always answering the mean over the training split."""
        answers = torch.cat([(each.target * each.target_unit).double() for each in train_samples])
        mean = answers.mean(dim=0)
        return float(np.mean([each.error for each in constant_rollouts(mean, samples)]))


def _mean_of_first(count: int, rolled: Sequence[RolloutErrors]) -> float | None:
    """Mean error of the first frames of rollouts; None if they are shorter."""
    if any(len(each.errors) < count for each in rolled):
        return None
    return float(np.mean([each.errors[:count].mean() for each in rolled]))


OBJECTIVES: dict[str, Objective] = {objective.name: objective() for objective in (NormalizedMSE, RolloutMSE)}


def objective_of(task: Task) -> Objective:
    """Return the objective that a task names."""
    return OBJECTIVES[task.objective]
