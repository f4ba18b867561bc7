"""The training loop: Adam on a loss of standardised targets."""

import math
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import islice

import torch
from jaxtyping import Float
from torch import Tensor

from cconv.devices import FLOAT32, TF32, Precision, products_in
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

    The rate falls, and unrolling begins, with the share of the budget that is spent.

    Attributes:
        updates: Largest number of gradient updates.
        cpu_seconds: Time after which no update begins: CPU time of this process in updates, without evaluations, so
            that what else the machine does takes nothing away; None for no such limit.
        evaluate_every: Updates between evaluations; the last update is always evaluated.
        batch_size: Frames of an update.
        learning_rate: Initial learning rate of Adam.
        schedule: "constant", "cosine" or "exponential"; the last two fall to 1 % of the initial rate.
        loss: Name in `LOSSES`.
        unroll: Steps of the model's own rollout that an update differentiates through; 1 for fields.
        unroll_from: Share of the budget after which there is more than one.
        average: Decay of the moving average of the weights that is evaluated; 0 evaluates the weights themselves.
    """

    updates: int
    evaluate_every: int
    cpu_seconds: float | None = None
    batch_size: int = 1
    learning_rate: float = 1e-3
    schedule: str = "cosine"
    loss: str = "mse"
    unroll: int = 1
    unroll_from: float = 0.5
    average: float = 0.0

    def share(self, progress: Progress) -> float:
        """Return the share of the budget that is spent, of the updates or of the time; from 1 on it is spent."""
        of_time = 0.0 if self.cpu_seconds is None else progress.cpu_seconds / self.cpu_seconds
        return max(progress.updates / self.updates, of_time)

    def rate_at(self, share: float) -> float:
        """Return the learning rate of an update, before which a share of the budget is spent."""
        return self.learning_rate * SCHEDULES[self.schedule](share)

    def steps_at(self, share: float) -> int:
        """Return the number of steps in an update, before which a share of the budget is spent."""
        return self.unroll if share >= self.unroll_from else 1


@dataclass(frozen=True, kw_only=True)
class TrainingState:
    """State of a training after a gradient update.

    Attributes:
        updates: Gradient updates done.
        train_loss: Loss of this update's batch.
        learning_rate: Learning rate of this update.
        valid_error: Validation error if an evaluation followed this update, else None.
        seconds: Time since training began, evaluations included.
        cpu_seconds: CPU time of the updates, without evaluations.
        share: Share of the budget that is spent.
        diverged: Whether a loss or validation error was not finite, which ends the training.
        model: The model as it is evaluated: with the weights of this update, or with their average.
    """

    updates: int
    train_loss: float
    learning_rate: float
    valid_error: float | None
    seconds: float
    cpu_seconds: float
    share: float
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
    judged = _judged(model, progress, optimization.average)
    start = time.perf_counter() - progress.seconds
    geometry = GeometryCache(model.geometry, cache_bytes)
    order = islice(batches(len(examples), optimization.batch_size, data_seed), progress.updates, None)
    while (share := optimization.share(progress)) < 1:
        began, update = time.process_time(), progress.updates + 1
        rate, steps = optimization.rate_at(share), optimization.steps_at(share)
        progress.optimizer.param_groups[0]["lr"] = rate
        batch = examples.draw(next(order), update, model, steps, share)
        loss = _update(model, batch, progress.optimizer, geometry, LOSSES[optimization.loss], steps)
        if progress.average is not None:
            update_average(progress.average, model, optimization.average, update)
        progress.updates, progress.cpu_seconds = update, progress.cpu_seconds + time.process_time() - began
        share = optimization.share(progress)
        valid = None
        if math.isfinite(loss) and (update % optimization.evaluate_every == 0 or share >= 1):
            valid = valid_error(judged, geometry)
        diverged = not math.isfinite(loss) or (valid is not None and not math.isfinite(valid))
        progress.seconds = time.perf_counter() - start
        yield TrainingState(
            updates=update,
            train_loss=loss,
            learning_rate=rate,
            valid_error=valid,
            seconds=progress.seconds,
            cpu_seconds=progress.cpu_seconds,
            share=share,
            diverged=diverged,
            model=judged,
        )
        if diverged:
            return


def _judged(model: Model, progress: Progress, average: float) -> Model:
    """The model that is evaluated: the average of its weights, which may begin here, or the model itself."""
    if average > 0 and progress.average is None:
        progress.average = begin_average(model)
    return progress.average or model


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
    backward: Precision = TF32 if model.config.precision == TF32 else FLOAT32  # autocast is for the way forward
    for sample in batch:
        loss = torch.stack(losses_of(model, sample, geometry, loss_of, steps)).sum() / frames
        with products_in(backward, model.device):
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
