"""Measures from the errors of single frames: with other variances, the thesis's measure, in blocks of time."""

from collections.abc import Iterable, Sequence

import numpy as np

from cconv.models.errors import FrameError, normalized_mse
from cconv.models.model import Model
from cconv.models.standardization import standardize_values
from cconv.tasks.samples import Sample


def own_variance(model: Model, samples: Iterable[Sample]) -> float:
    """Return variance of the target over samples ÷ variance over the training split of a model.

    A normalized MSE divided by it is relative to the variance of these samples: predicting their own mean scores 1.
    """
    targets = standardize_values(model.standardize_target(sample.target) for sample in samples)
    return float(targets.scale[0] ** 2)


def per_frame_normalized_mse(errors: Sequence[FrameError]) -> float | None:
    """Average over frames the error divided by each frame's own variance, only to compare with the thesis.

    Frames with a constant target are ignored; None if there are no others.
    """
    defined = [error.per_frame_normalized_mse for error in errors if error.per_frame_normalized_mse is not None]
    return float(np.mean(defined)) if defined else None


def blocks_of_errors(errors: Sequence[FrameError], frames_per_block: int) -> np.ndarray:
    """Average the errors over the units of an interval: trajectories, or blocks of frames of a single one.

    Neighbouring frames are similar, so with single frames as units an interval would be too narrow.

    Args:
        errors: Errors of the frames of a split, in order.
        frames_per_block: Approximate length of the blocks if there is one trajectory; all have nearly the same length.

    Returns:
        Mean error of each unit, (units,).
    """
    trajectories = list(dict.fromkeys(error.trajectory for error in errors))
    if len(trajectories) > 1:
        groups = [[error for error in errors if error.trajectory == name] for name in trajectories]
    else:
        blocks = np.array_split(np.arange(len(errors)), max(1, round(len(errors) / frames_per_block)))
        groups = [[errors[index] for index in block] for block in blocks]
    return np.array([normalized_mse(group) for group in groups])
