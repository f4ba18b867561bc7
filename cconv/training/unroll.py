"""Unrolling: a model learns from states that its own rollout leads to."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from cconv.data.trajectory import Scene
from cconv.data.window import Window, join_windows, joinable
from cconv.models.model import FrameGeometry, Model
from cconv.rollout.correctors import correctors_of
from cconv.rollout.rollout import StepModel, begun, followed
from cconv.tasks.samples import Sample, StepSample, make_step_sample


@dataclass(frozen=True)
class Pushforward:
    """Steps of the model's own rollout before the step that it learns from, without gradients through them.

    It begins late, because an untrained model would clump the particles. Source: Brandstetter, Worrall, Welling,
    "Message Passing Neural PDE Solvers" (ICLR 2022), section 3.1.

    Attributes:
        most: Largest number of steps; each number from 0 to it is as likely.
        begins: Share of the budget after which there are any.
    """

    most: int
    begins: float

    def steps(self, share: float, generator: torch.Generator) -> int:
        """Draw the number of steps in an update, before which a share of the budget is spent; none before the first."""
        begun = share > 0 and share >= self.begins
        return int(torch.randint(self.most + 1, (), generator=generator)) if begun else 0


@torch.no_grad()
def pushed(model: StepModel, windows: Sequence[Window], scene: Scene, steps: Sequence[int]) -> list[Window]:
    """The windows that rollouts of some steps each lead to, or as far as they come before they diverge.

    Args:
        model: The model.
        windows: Where the rollouts begin.
        scene: Their scene.
        steps: Steps of each.
    """
    windows, left, correctors = list(windows), list(steps), correctors_of(model)
    while moving := [number for number, count in enumerate(left) if count > 0]:
        for group in joinable([windows[number] for number in moving]):
            numbers = [moving[place] for place in group]
            together = begun(join_windows([windows[number] for number in numbers]))
            following, ends = followed(model.predict_frame, model.task.integrator, together, scene, correctors)
            for number, window, end in zip(numbers, following.separated(), ends, strict=True):
                left[number] = left[number] - 1 if end is None else 0
                windows[number] = window if end is None else windows[number]
    return windows


class Answered(NamedTuple):
    """What a model has answered about a window in a step of an unrolled rollout.

    Attributes:
        window: Number of the window, among several in one graph.
        prediction: Standardised prediction (M, C).
        target: Standardised target (M, C).
        neighbors: Number of neighbours of each particle, itself not counted, (M,).
    """

    window: int
    prediction: Tensor
    target: Tensor
    neighbors: Tensor


def unrolled(
    model: Model, sample: Sample, steps: int, geometry: Callable[[Sample], FrameGeometry]
) -> Iterator[list[Answered]]:
    """Yield what a model answers in consecutive steps of its own rollout from a sample, about each of its windows.

    Gradients flow back through the steps, by way of the positions: the target of a later step is what would lead to the
    stored frame from where the model has come, so that its error is that of the rollout's positions. The rollout of a
    window ends early where it diverges, or where no frame is stored to compare with. Source: Ummenhofer et al.,
    "Lagrangian Fluid Simulation with Continuous Convolutions" (ICLR 2020), whose loss has two steps.

    Args:
        model: The model.
        sample: Where the rollouts begin; of a step task if there is more than one step.
        steps: Number of steps.
        geometry: Function from a sample to its geometry, e.g. a cache.
    """
    numbers = list(range(len(sample.origins)))
    seen = geometry(sample)
    prediction = model(sample.inputs, seen)
    yield _answers(model, sample, prediction, seen, numbers)
    for _ in range(steps - 1):
        following = _followed(model, sample, prediction)
        if following is None:
            return
        sample, kept = following
        numbers = [number for number, keep in zip(numbers, kept, strict=True) if keep]
        seen = model.geometry(sample.inputs)
        prediction = model(sample.inputs, seen)
        yield _answers(model, sample, prediction, seen, numbers)


def _answers(
    model: Model, sample: Sample, prediction: Tensor, seen: FrameGeometry, numbers: Sequence[int]
) -> list[Answered]:
    """Answers about windows with some numbers."""
    counts, answered, neighbors = sample.inputs.answer_counts, sample.inputs.answered, seen.fluid.neighbor_counts
    neighbors = neighbors if answered is None else neighbors[answered.to(neighbors.device)]
    parts = prediction.split(counts), model.standardize_target(sample.target).split(counts), neighbors.split(counts)
    return [Answered(*each) for each in zip(numbers, *parts, strict=True)]


def _followed(model: Model, sample: Sample, prediction: Tensor) -> tuple[StepSample, list[bool]] | None:
    """The sample that a standardised prediction leads to, and which of its windows are left; None if there is none."""
    if not isinstance(sample, StepSample) or len(sample.window.future) < 2:
        return None
    answer = model.in_units_of_data(prediction, sample.inputs)
    start, correctors = begun(sample.window), correctors_of(model)
    window, ends = followed(lambda window, scene: answer, sample.task.integrator, start, sample.scene, correctors)
    kept = [end is None for end in ends]
    if not any(kept):
        return None
    return make_step_sample(window.only(kept), sample.scene, sample.task, model.config.features), kept
