"""The training loop: Adam on the mean squared error of standardised targets."""

import math
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import islice

import torch
import torch.nn.functional as F

from cconv.errors import check_choice
from cconv.models.errors import frame_errors, normalized_mse
from cconv.models.model import Model
from cconv.tasks.samples import Sample
from cconv.training.batches import batches
from cconv.training.geometry_cache import GeometryCache
from cconv.training.progress import Progress, begin

SCHEDULES = {
    "constant": lambda progress: 1.0,
    "cosine": lambda progress: 0.01 + 0.99 * (1 + math.cos(math.pi * progress)) / 2,
    "exponential": lambda progress: 0.01**progress,
}


@dataclass(frozen=True, kw_only=True)
class TrainingState:
    """Where training stands after a gradient update.

    Attributes:
        updates: Gradient updates done.
        train_loss: Mean squared error of standardised targets in this update's batch.
        learning_rate: Learning rate of this update.
        valid_error: Validation error, where this update was followed by an evaluation, else None.
        seconds: Time since training began, evaluations included.
        diverged: Whether a loss or validation error was not finite; training ends there.
    """

    updates: int
    train_loss: float
    learning_rate: float
    valid_error: float | None
    seconds: float
    diverged: bool


def train(
    model: Model,
    train_samples: Sequence[Sample],
    valid_samples: Sequence[Sample],
    *,
    updates: int,
    evaluate_every: int,
    batch_size: int = 1,
    learning_rate: float = 1e-3,
    schedule: str = "cosine",
    data_seed: int = 0,
    cache_bytes: int = 2**31,
    progress: Progress | None = None,
) -> Iterator[TrainingState]:
    """Train `model` in place; yields after every update, so that the caller decides when to stop and what to keep.

    Args:
        model: Model to train.
        train_samples: Frames to learn from.
        valid_samples: Frames of the validation error.
        updates: Gradient updates in all.
        evaluate_every: Updates between evaluations; the last update is always evaluated.
        batch_size: Frames of an update.
        learning_rate: Initial learning rate of Adam.
        schedule: "constant", "cosine" or "exponential"; the latter two fall to 1 %.
        data_seed: Seed of the batch order.
        cache_bytes: Memory for the geometries of frames, at most.
        progress: Where an earlier training of the same model and settings stands, from where it goes on as if it had
            not been interrupted; moved on in place. None begins.

    Raises:
        ConfigError: If the schedule is unknown.
    """
    check_choice("schedule", schedule, SCHEDULES)
    progress = progress or begin(model)
    start = time.perf_counter() - progress.seconds
    geometry = GeometryCache(model.geometry, cache_bytes)
    order = islice(batches(len(train_samples), batch_size, data_seed), progress.updates, updates)
    for update, indices in enumerate(order, start=progress.updates + 1):
        rate = learning_rate * SCHEDULES[schedule]((update - 1) / updates)
        progress.optimizer.param_groups[0]["lr"] = rate
        loss = _update(model, [train_samples[index] for index in indices], progress.optimizer, geometry)
        valid = None
        if math.isfinite(loss) and (update % evaluate_every == 0 or update == updates):
            valid = normalized_mse(frame_errors(model, valid_samples, geometry))
        diverged = not math.isfinite(loss) or (valid is not None and not math.isfinite(valid))
        progress.updates, progress.seconds = update, time.perf_counter() - start
        yield TrainingState(
            updates=update,
            train_loss=loss,
            learning_rate=rate,
            valid_error=valid,
            seconds=progress.seconds,
            diverged=diverged,
        )
        if diverged:
            return


def _update(model: Model, batch: Sequence[Sample], optimizer: torch.optim.Optimizer, geometry: GeometryCache) -> float:
    """One step on the mean over the frames of a batch; frame by frame, so that memory does not grow with the batch."""
    optimizer.zero_grad()
    total = 0.0
    for sample in batch:
        prediction = model(sample.inputs, geometry(sample))
        loss = F.mse_loss(prediction, model.standardize_target(sample.target)) / len(batch)
        loss.backward()
        total += loss.item()
    if math.isfinite(total):
        optimizer.step()
    return total
