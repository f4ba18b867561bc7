"""Errors of a model on samples, and their intervals."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import numpy as np
import torch

from cconv.data.targets import Sample


@dataclass(frozen=True, kw_only=True)
class FrameError:
    """Error of a model on one frame.

    Attributes:
        trajectory: Name of the frame's trajectory.
        frame: Index of the frame in it.
        num_particles: Fluid particles N.
        normalized_mse: Mean squared error over particles and components / variance of the target over training.
        per_frame_normalized_mse: The same, divided by the variance of this frame's own target (the thesis's measure).
    """

    trajectory: str
    frame: int
    num_particles: int
    normalized_mse: float
    per_frame_normalized_mse: float


@torch.no_grad()
def frame_errors(model, samples: Iterable[Sample], geometry: Callable | None = None) -> list[FrameError]:
    """Errors of a model on each frame.

    Args:
        model: A `FieldModel`.
        samples: Frames with targets.
        geometry: Sample to geometry, e.g. a cache; by default computed afresh.
    """
    geometry = geometry or (lambda sample: model.geometry(sample.inputs))
    errors = []
    for sample in samples:
        target = model.standardize_target(sample.target)
        squared = (model(sample.inputs, geometry(sample)) - target).double().square().mean().item()
        own_variance = target.double().var(dim=0, correction=0).mean().item()
        errors.append(
            FrameError(
                trajectory=sample.trajectory,
                frame=sample.frame,
                num_particles=len(target),
                normalized_mse=squared,
                per_frame_normalized_mse=squared / own_variance if own_variance > 0 else float("nan"),
            )
        )
    return errors


def normalized_mse(errors: Sequence[FrameError]) -> float:
    """Mean squared error over a split / variance of the target over the training split."""
    weights = [error.num_particles for error in errors]
    return float(np.average([error.normalized_mse for error in errors], weights=weights))


def per_frame_normalized_mse(errors: Sequence[FrameError]) -> float:
    """Mean over frames of the error z-scored by each frame's own target; only to compare with the thesis."""
    return float(np.mean([error.per_frame_normalized_mse for error in errors]))


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


def bootstrap_interval(
    values: np.ndarray, *, confidence: float = 0.95, resamples: int = 4000, seed: int = 0
) -> tuple[float, float]:
    """Percentile bootstrap interval of the mean of a crossed table.

    Seeds and units (trajectories or time blocks) are resampled independently, with replacement, so that both sources
    of variation count.

    Args:
        values: Errors (seeds, units).
        confidence: Share of the resampled means within the interval.
        resamples: Number of resampled means.
        seed: Seed of the resampling.

    Returns:
        Lower and upper end.
    """
    rng = np.random.default_rng(seed)
    num_seeds, num_units = values.shape
    rows = rng.integers(num_seeds, size=(resamples, num_seeds))
    columns = rng.integers(num_units, size=(resamples, num_units))
    means = values[rows[:, :, None], columns[:, None, :]].mean(axis=(1, 2))
    tail = (1 - confidence) / 2
    low, high = np.quantile(means, [tail, 1 - tail])
    return float(low), float(high)
