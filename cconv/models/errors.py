"""Errors of a model on samples, and of the trivial model that always predicts the mean."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from cconv.models.model import Model
from cconv.models.standardization import standardize_values
from cconv.tasks.samples import Sample


@dataclass(frozen=True, kw_only=True)
class FrameError:
    """Error of a model on one frame.

    Attributes:
        trajectory: Name of the frame's trajectory.
        frame: Index of the frame in it.
        num_particles: Fluid particles N.
        normalized_mse: Mean squared error over particles and components / variance of the target over training.
        per_frame_normalized_mse: The same, divided by the variance of this frame's own target (the thesis's measure);
            None where that target is constant.
    """

    trajectory: str
    frame: int
    num_particles: int
    normalized_mse: float
    per_frame_normalized_mse: float | None


@torch.no_grad()
def frame_errors(model: Model, samples: Iterable[Sample], geometry: Callable | None = None) -> list[FrameError]:
    """Compute the errors of a model on each frame.

    Args:
        model: The model.
        samples: Frames with targets.
        geometry: Function from a sample to its geometry, e.g. a cache; by default it is computed anew.
    """
    geometry = geometry or (lambda sample: model.geometry(sample.inputs))
    errors = []
    for stored in samples:
        sample = stored.to(model.home)
        target = model.standardize_target(sample.target)
        errors.append(_frame_error(sample, model(sample.inputs, geometry(sample)), target))
    return errors


def mean_predictor_error(samples: Iterable[Sample], train_samples: Iterable[Sample]) -> list[FrameError]:
    """Compute the error on each frame of predicting the mean of the training split everywhere.

    Their `normalized_mse` is 1 on the training split by definition. On another split it is larger if the target varies
    more than in the training split, and smaller if it varies less. A useful model is well below it.

    Args:
        samples: Frames of a split.
        train_samples: Frames of the training split.
    """
    training = standardize_values(sample.target for sample in train_samples)
    errors = []
    for sample in samples:
        target = (sample.target.double() - training.mean) / training.scale
        errors.append(_frame_error(sample, torch.zeros_like(target), target))
    return errors


def _frame_error(sample: Sample, prediction: Float[Tensor, "N C"], target: Float[Tensor, "N C"]) -> FrameError:
    """Error of a standardised prediction of a standardised target, both (N, C)."""
    squared = (prediction - target).double().square().mean().item()
    own_variance = target.double().var(dim=0, correction=0).mean().item()
    return FrameError(
        trajectory=sample.trajectory,
        frame=sample.frame,
        num_particles=len(target),
        normalized_mse=squared,
        per_frame_normalized_mse=squared / own_variance if own_variance > 0 else None,
    )


def normalized_mse(errors: Sequence[FrameError]) -> float:
    """Mean squared error over a split / variance of the target over the training split."""
    weights = [error.num_particles for error in errors]
    return float(np.average([error.normalized_mse for error in errors], weights=weights))
