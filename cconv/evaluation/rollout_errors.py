"""Errors of rollouts that begin at samples, against the frames that are stored after them."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float
from torch import Tensor

from cconv.data.trajectory import Scene
from cconv.data.window import Window, join_windows, joinable
from cconv.domain import Box
from cconv.errors import ConfigError
from cconv.evaluation.rollout_metrics import squared_errors
from cconv.models.model import Model
from cconv.rollout.correctors import Corrector, correctors_of
from cconv.rollout.rollout import Diverged, StepModel, begun, followed
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


def rollouts_of(model: Model, samples: Iterable[Sample]) -> list[RolloutErrors]:
    """Roll a model out, with its relaxation, from samples of its task, for as many frames as are known after each."""
    task, home = as_step(model.task), model.home  # its integrator may be another
    asked = [replace(start.to(home), task=task) for start in starts(samples)]
    return joined_errors(model.predict_frame, asked, correctors_of(model))


def rollout_errors_of(model: StepModel, start: StepSample, correctors: Sequence[Corrector] = ()) -> RolloutErrors:
    """Errors of one rollout of a model of a step task, whose integrator may be another than that of the sample."""
    return rollout_errors(model.predict_frame, replace(start, task=as_step(model.task)), correctors)


def constant_rollouts(answer: Float[Tensor, " C"], samples: Iterable[Sample]) -> list[RolloutErrors]:
    """Roll out the same answer (C,) for every particle and frame, from samples of a step task."""

    def predict(window: Window, scene: Scene) -> Tensor:
        return answer.expand(int(window.is_fluid.sum()), -1)

    return joined_errors(predict, starts(samples))


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
    (errors,) = _errors_of_group(predict, [start], correctors)
    return errors


def joined_errors(
    predict: Callable[[Window, Scene], Tensor], begun_at: Sequence[StepSample], correctors: Sequence[Corrector] = ()
) -> list[RolloutErrors]:
    """Errors of several rollouts, which advance together where their windows can be joined.

    A rollout that diverges leaves the others, and its further frames count as the worst.

    Args:
        predict: One window, or several joined, and their scene to the answer (M, D) for each of the M fluid particles.
        begun_at: Starts of the rollouts, of one task, in any scenes.
        correctors: What corrects every frame, one after another.
    """
    found: dict[int, RolloutErrors] = {}
    scenes = {id(start.scene): start.scene for start in begun_at}
    for scene in scenes.values():
        numbers = [number for number, start in enumerate(begun_at) if start.scene is scene]
        for group in joinable([begun_at[number].window for number in numbers]):
            together = [numbers[place] for place in group]
            errors = _errors_of_group(predict, [begun_at[number] for number in together], correctors)
            found |= dict(zip(together, errors, strict=True))
    return [found[number] for number in range(len(begun_at))]


def _errors_of_group(
    predict: Callable[[Window, Scene], Tensor], group: Sequence[StepSample], correctors: Sequence[Corrector]
) -> list[RolloutErrors]:
    """Errors of rollouts that begin with windows that can be joined."""
    scene, integrator = group[0].scene, group[0].task.integrator
    worst = worst_error(scene.box)
    errors = np.full((len(group), len(group[0].window.future)), worst)
    diverged: list[str | None] = [None] * len(group)
    last = [start.window.present.double() for start in group]
    window, going = begun(join_windows([start.window for start in group])), list(range(len(group)))
    for frame in range(errors.shape[1]):
        try:
            window, ends = followed(predict, integrator, window, scene, correctors)
        except Diverged as error:  # of a solver in the place of a model
            ends = [error] * len(going)
        for number, end in zip(going, ends, strict=True):
            diverged[number] = None if end is None else end.reason
        going = [number for number in going if diverged[number] is None]
        if not going:
            break
        window = window.only([end is None for end in ends])
        for number, part in zip(going, window.separated(), strict=True):
            stored = group[number].window.future[frame]
            last[number] = part.present
            errors[number, frame] = min(float(squared_errors(part.present[None], stored[None], scene.box)), worst)
    return [
        RolloutErrors(
            trajectory=start.trajectory, frame=start.window.frame, errors=found, diverged=reason, last=reached
        )
        for start, found, reason, reached in zip(group, errors, diverged, last, strict=True)
    ]
