"""Errors of rollouts that begin at samples, against the frames that are stored after them."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float
from torch import Tensor

from cconv.data.trajectory import Scene
from cconv.data.window import Window
from cconv.domain import Box
from cconv.errors import ConfigError
from cconv.evaluation.rollout_metrics import squared_errors
from cconv.rollout.correctors import Corrector, correctors_of
from cconv.rollout.rollout import Diverged, StepModel, advance
from cconv.tasks.samples import Sample, StepSample
from cconv.tasks.task import as_step


@dataclass(frozen=True, kw_only=True)
class RolloutErrors:
    """Errors of one rollout.

    Attributes:
        trajectory: Name of its trajectory.
        frame: Index of the frame that it began with.
        errors: Mean squared error of the positions in each of its frames, (T,), at most `worst_error`.
        diverged: Why it ended early; None if it reached its last frame.
        last: Positions in the last frame that it reached, (N, D), float64; those of the start if it reached none.
    """

    trajectory: str
    frame: int
    errors: np.ndarray
    diverged: str | None
    last: Tensor

    @property
    def error(self) -> float:
        """Mean over the frames, LagrangeBench's MSE_n for n frames."""
        return float(self.errors.mean())


def worst_error(box: Box) -> float:
    """Squared error of positions that are half the box off along each axis, which no periodic error exceeds."""
    return float(np.mean([(length / 2) ** 2 for length in box.lengths]))


def rollouts_of(model: StepModel, samples: Iterable[Sample]) -> list[RolloutErrors]:
    """Roll a model out, with its relaxation, from samples of its task, for as many frames as are known after each."""
    return [rollout_errors_of(model, start, correctors_of(model)) for start in starts(samples)]


def rollout_errors_of(model: StepModel, start: StepSample, correctors: Sequence[Corrector] = ()) -> RolloutErrors:
    """Errors of one rollout of a model of a step task, whose integrator may be another than that of the sample."""
    return rollout_errors(model.predict_frame, replace(start, task=as_step(model.task)), correctors)


def constant_rollouts(answer: Float[Tensor, " C"], samples: Iterable[Sample]) -> list[RolloutErrors]:
    """Roll out the same answer (C,) for every particle and frame, from samples of a step task."""

    def predict(window: Window, scene: Scene) -> Tensor:
        return answer.expand(int(window.is_fluid.sum()), -1)

    return [rollout_errors(predict, start) for start in starts(samples)]


def starts(samples: Iterable[Sample]) -> list[StepSample]:
    """Return the samples, which rollouts can begin with only if they are of a step task.

    Raises:
        ConfigError: If one is of a field.
    """
    found = [sample for sample in samples if isinstance(sample, StepSample)]
    if not found:
        raise ConfigError("a rollout needs windows of a step task, e.g. 'acceleration', and there are none.")
    return found


def rollout_errors(
    predict: Callable[[Window, Scene], Tensor], start: StepSample, correctors: Sequence[Corrector] = ()
) -> RolloutErrors:
    """Errors of one rollout in each frame that is known after its start; arguments as of `advance`."""
    scene, future = start.scene, start.window.future
    worst = worst_error(scene.box)
    errors = np.full(len(future), worst)
    path = advance(predict, start.task.integrator, start.window, scene, correctors=correctors)
    diverged, last = None, start.window.present.double()
    try:
        for place, window in zip(range(len(future)), path, strict=False):
            found = float(squared_errors(window.present[None], future[place][None], scene.box))
            errors[place], last = min(found, worst), window.present
    except Diverged as error:
        diverged = error.reason
    return RolloutErrors(
        trajectory=start.trajectory, frame=start.window.frame, errors=errors, diverged=diverged, last=last
    )
