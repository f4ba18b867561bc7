"""Measures made of the errors of single frames: by other variances, by the thesis's measure, by blocks of time."""

from collections.abc import Iterable, Sequence

import numpy as np

from cconv.models.errors import FrameError, normalized_mse
from cconv.models.model import Model
from cconv.models.standardization import standardize_values
from cconv.tasks.samples import Sample


def own_variance(model: Model, samples: Iterable[Sample]) -> float:
    """Variance of the target over samples / that over the training split of a model.

    An error divided by it is one by the variance of these samples: 1 is predicting their own mean.
    """
    targets = standardize_values(model.standardize_target(sample.target) for sample in samples)
    return float(targets.scale[0] ** 2)


def per_frame_normalized_mse(errors: Sequence[FrameError]) -> float | None:
    """Mean over frames of the error z-scored by each frame's own target; only to compare with the thesis.

    Frames with a constant target do not count; None if there are no others.
    """
    defined = [error.per_frame_normalized_mse for error in errors if error.per_frame_normalized_mse is not None]
    return float(np.mean(defined)) if defined else None


def blocks_of_errors(errors: Sequence[FrameError], frames_per_block: int) -> np.ndarray:
    """Errors averaged over the units that an interval resamples: trajectories, or blocks of frames of a single one.

    Neighbouring frames are alike, so single frames would make an interval too narrow.

    Args:
        errors: Errors of the frames of a split, in order.
        frames_per_block: Frames of a block, nearly, where there is only one trajectory; blocks are alike in length.

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
