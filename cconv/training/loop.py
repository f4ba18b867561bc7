"""The training loop: Adam on a loss of standardised targets."""

import math
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import islice

import torch
from jaxtyping import Float
from torch import Tensor

from cconv.errors import check_choice
from cconv.models.model import FrameGeometry, Model
from cconv.tasks.samples import Sample
from cconv.training.averages import begin_average, update_average
from cconv.training.batches import batches
from cconv.training.examples import Examples
from cconv.training.geometry_cache import GeometryCache
from cconv.training.losses import LOSSES, Loss
from cconv.training.progress import Progress, begin
from cconv.training.unroll import unrolled

SCHEDULES = {
    "constant": lambda progress: 1.0,
    "cosine": lambda progress: 0.01 + 0.99 * (1 + math.cos(math.pi * progress)) / 2,
    "exponential": lambda progress: 0.01**progress,
}


@dataclass(frozen=True, kw_only=True)
class Optimization:
    """Budget and settings of the optimiser of a training.

    Attributes:
        updates: Number of gradient updates.
        evaluate_every: Updates between evaluations; the last update is always evaluated.
        batch_size: Frames of an update.
        learning_rate: Initial learning rate of Adam.
        schedule: "constant", "cosine" or "exponential"; the last two fall to 1 % of the initial rate.
        loss: Name in `LOSSES`.
        unroll: Steps of the model's own rollout that an update differentiates through; 1 for fields.
        unroll_from: Share of the updates after which there is more than one.
        average: Decay of the moving average of the weights that is evaluated; 0 evaluates the weights themselves.
    """

    updates: int
    evaluate_every: int
    batch_size: int = 1
    learning_rate: float = 1e-3
    schedule: str = "cosine"
    loss: str = "mse"
    unroll: int = 1
    unroll_from: float = 0.5
    average: float = 0.0

    def rate_at(self, update: int) -> float:
        """Return the learning rate of an update, counted from 1."""
        return self.learning_rate * SCHEDULES[self.schedule]((update - 1) / self.updates)

    def steps_at(self, update: int) -> int:
        """Return the number of steps in an update, counted from 1."""
        return self.unroll if update > self.unroll_from * self.updates else 1

    def is_evaluated(self, update: int) -> bool:
        """Tell whether an evaluation follows an update."""
        return update % self.evaluate_every == 0 or update == self.updates


@dataclass(frozen=True, kw_only=True)
class TrainingState:
    """State of a training after a gradient update.

    Attributes:
        updates: Gradient updates done.
        train_loss: Loss of this update's batch.
        learning_rate: Learning rate of this update.
        valid_error: Validation error if an evaluation followed this update, else None.
        seconds: Time since training began, evaluations included.
        diverged: Whether a loss or validation error was not finite, which ends the training.
        model: The model as it is evaluated: with the weights of this update, or with their average.
    """

    updates: int
    train_loss: float
    learning_rate: float
    valid_error: float | None
    seconds: float
    diverged: bool
    model: Model


def train(
    model: Model,
    examples: Examples,
    valid_error: Callable[[Model, GeometryCache], float],
    optimization: Optimization,
    *,
    data_seed: int = 0,
    cache_bytes: int = 2**31,
    progress: Progress | None = None,
) -> Iterator[TrainingState]:
    """Train `model` in place; yield after every update, so that the caller decides when to stop and what to keep.

    Args:
        model: Model to train.
        examples: Frames to learn from.
        valid_error: Function from a cache of geometries to the validation error of the model.
        optimization: Budget and optimiser.
        data_seed: Seed of the batch order.
        cache_bytes: Largest memory for the geometries of frames.
        progress: Progress of an earlier training with the same model and settings, which continues as if it had not
            been interrupted; it is updated in place. None begins a new training.

    Raises:
        ConfigError: If the schedule or the loss is unknown.
    """
    check_choice("schedule", optimization.schedule, SCHEDULES)
    check_choice("loss", optimization.loss, LOSSES)
    progress = progress or begin(model)
    if optimization.average > 0 and progress.average is None:
        progress.average = begin_average(model)
    judged = progress.average or model
    start = time.perf_counter() - progress.seconds
    geometry = GeometryCache(model.geometry, cache_bytes)
    order = batches(len(examples), optimization.batch_size, data_seed)
    order = islice(order, progress.updates, optimization.updates)
    for update, indices in enumerate(order, start=progress.updates + 1):
        rate = optimization.rate_at(update)
        progress.optimizer.param_groups[0]["lr"] = rate
        steps = optimization.steps_at(update)
        batch = examples.draw(indices, update, model, steps)
        loss = _update(model, batch, progress.optimizer, geometry, LOSSES[optimization.loss], steps)
        if progress.average is not None:
            update_average(progress.average, model, optimization.average, update)
        valid = None
        if math.isfinite(loss) and optimization.is_evaluated(update):
            valid = valid_error(judged, geometry)
        diverged = not math.isfinite(loss) or (valid is not None and not math.isfinite(valid))
        progress.updates, progress.seconds = update, time.perf_counter() - start
        yield TrainingState(
            updates=update,
            train_loss=loss,
            learning_rate=rate,
            valid_error=valid,
            seconds=progress.seconds,
            diverged=diverged,
            model=judged,
        )
        if diverged:
            return


def _update(
    model: Model,
    batch: Sequence[Sample],
    optimizer: torch.optim.Optimizer,
    geometry: GeometryCache,
    loss_of: Loss,
    steps: int,
) -> float:
    """Take one step on the mean loss of a batch, graph by graph, so that memory does not grow with the batch."""
    optimizer.zero_grad()
    frames, total = sum(len(sample.origins) for sample in batch), 0.0
    for sample in batch:
        loss = torch.stack(losses_of(model, sample, geometry, loss_of, steps)).sum() / frames
        loss.backward()
        total += loss.item()
    if math.isfinite(total):
        optimizer.step()
    return total


def losses_of(
    model: Model, sample: Sample, geometry: Callable[[Sample], FrameGeometry], loss_of: Loss, steps: int
) -> list[Float[Tensor, ""]]:
    """Loss of each frame of a sample, the mean over its steps.

    Args:
        model: The model.
        sample: One frame, or several in one graph.
        geometry: Function from a sample to its geometry, e.g. a cache.
        loss_of: Loss of a frame.
        steps: Steps that are learned at once, of the model's own rollout.
    """
    losses: list[list[Tensor]] = [[] for _ in sample.origins]
    for answers in unrolled(model, sample, steps, geometry):
        for window, *answer in answers:
            losses[window].append(loss_of(*answer))
    return [torch.stack(each).mean() for each in losses]
