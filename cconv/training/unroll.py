"""Unrolling: a model learns from states that its own rollout leads to."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import islice

import torch
from torch import Tensor

from cconv.data.trajectory import Scene
from cconv.data.window import Window
from cconv.models.model import FrameGeometry, Model
from cconv.rollout.rollout import Diverged, StepModel, advance, rollout
from cconv.tasks.samples import Sample, StepSample, make_step_sample


@dataclass(frozen=True)
class Pushforward:
    """Steps of the model's own rollout before the step that it learns from, without gradients through them.

    It begins late, because an untrained model would clump the particles. Source: Brandstetter, Worrall, Welling,
    "Message Passing Neural PDE Solvers" (ICLR 2022), section 3.1.

    Attributes:
        most: Largest number of steps; each number from 0 to it is as likely.
        begins: First update in which there are any.
    """

    most: int
    begins: int

    def steps(self, update: int, generator: torch.Generator) -> int:
        """Draw the number of steps in an update."""
        return int(torch.randint(self.most + 1, (), generator=generator)) if update >= self.begins else 0


@torch.no_grad()
def pushed(model: StepModel, window: Window, scene: Scene, steps: int) -> Window:
    """The window that a rollout of some steps leads to, or as far as it comes before it diverges."""
    try:
        for following in islice(rollout(model, window, scene), steps):
            window = following
    except Diverged:
        pass
    return window


def unrolled(
    model: Model, sample: Sample, steps: int, geometry: Callable[[Sample], FrameGeometry]
) -> Iterator[tuple[Tensor, Tensor]]:
    """Yield standardised prediction and target (M, C) of consecutive steps of the model's own rollout from a sample.

    Gradients flow back through the steps, by way of the positions: the target of a later step is what would lead to the
    stored frame from where the model has come, so that its error is that of the rollout's positions. The rollout ends
    early where it diverges, or where no frame is stored to compare with. Source: Ummenhofer et al., "Lagrangian Fluid
    Simulation with Continuous Convolutions" (ICLR 2020), whose loss has two steps.

    Args:
        model: The model.
        sample: Where the rollout begins; of a step task if there is more than one step.
        steps: Number of steps.
        geometry: Function from a sample to its geometry, e.g. a cache.
    """
    prediction = model(sample.inputs, geometry(sample))
    yield prediction, model.standardize_target(sample.target)
    for _ in range(steps - 1):
        following = _followed(model, sample, prediction)
        if following is None:
            return
        sample = following
        prediction = model(sample.inputs, model.geometry(sample.inputs))
        yield prediction, model.standardize_target(sample.target)


def _followed(model: Model, sample: Sample, prediction: Tensor) -> StepSample | None:
    """The sample that a standardised prediction leads to; None if there is none."""
    if not isinstance(sample, StepSample) or len(sample.window.future) < 2:
        return None
    answer = model.in_units_of_data(prediction, sample.inputs)
    path = advance(lambda window, scene: answer, sample.task.integrator, sample.window, sample.scene)
    try:
        window = next(path)
    except Diverged:
        return None
    return make_step_sample(window, sample.scene, sample.task, model.config.features)
