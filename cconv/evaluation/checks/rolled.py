"""What checks of rollouts share: rollouts over whole trajectories and twice as long, and limits from what is stored."""

from abc import abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import islice
from typing import ClassVar

import torch
from torch import Tensor

from cconv.data.splits import evenly_spaced
from cconv.data.trajectory import Scene, Trajectory
from cconv.data.window import Window, window_at
from cconv.evaluation.checks.check import Check, Finding
from cconv.models.model import Model
from cconv.rollout.rollout import Diverged, StepModel, rollout
from cconv.tasks.task import StepTask

MOST_STARTS = 3  # trajectories that rollouts begin in
LONGER = 2  # rollouts are as many times as long as what is stored


@dataclass(frozen=True, kw_only=True)
class Rolled:
    """A rollout, and the window that it began with.

    Attributes:
        start: The window; its future is the rest of the stored trajectory.
        positions: The present of the start and the frames of the rollout, as far as it came, (1 + T, N, D).
        ended: Why it ended early; None if it did not.
    """

    start: Window
    positions: Tensor
    ended: str | None


@dataclass(frozen=True, kw_only=True)
class RolloutMaterial:
    """Starts of rollouts of a scene for all checks and all models of a step task.

    Attributes:
        task: Task of the models.
        scene: Scene of the trajectories.
        starts: Windows at the beginning of trajectories that no model was trained on.
    """

    task: StepTask
    scene: Scene
    starts: tuple[Window, ...]
    _last: dict[int, tuple[StepModel, tuple[Rolled, ...]]] = field(default_factory=dict)

    def predictor(self, model: Model) -> Model:
        """Return what checks test of a model: the model itself, which they roll out."""
        return model

    @property
    def counts(self) -> dict[str, int]:
        """Numbers of what is looked at, for a reader: rollouts, and no perturbed frame."""
        return {"plain_frames": len(self.starts), "stressed_frames": 0}

    def rolled(self, model: StepModel) -> tuple[Rolled, ...]:
        """Roll a model out from every start, once for all checks."""
        if id(model) not in self._last:
            self._last.clear()  # of the model before, whose checks are done
            self._last[id(model)] = model, tuple(_roll(model, start, self.scene) for start in self.starts)
        return self._last[id(model)][1]


def make_rollout_material(trajectories: Sequence[Trajectory], scene: Scene, task: StepTask) -> RolloutMaterial:
    """Choose the starts of rollouts: the first windows of some trajectories."""
    chosen = [trajectories[place] for place in evenly_spaced(len(trajectories), MOST_STARTS)]
    present = task.history - 1
    starts = [window_at(each, present, task.history, len(each) - task.history) for each in chosen]
    return RolloutMaterial(task=task, scene=scene, starts=tuple(starts))


def _roll(model: StepModel, start: Window, scene: Scene) -> Rolled:
    frames, ended = [start.present.double()], None
    try:
        for window in islice(rollout(model, start, scene), LONGER * len(start.future)):
            frames.append(window.present)
    except Diverged as error:
        ended = str(error)
    return Rolled(start=start, positions=torch.stack(frames), ended=ended)


@dataclass(frozen=True)
class Bound:
    """How large a quantity may become in a rollout.

    Attributes:
        least: Limit where the stored trajectories stay far below it.
        slack: Limit as a multiple of the largest value in the stored trajectories, if that is more.
    """

    least: float
    slack: float


class SeriesCheck(Check[RolloutMaterial, StepModel]):
    """A check of quantities in every frame of a rollout, of which each has a bound.

    Attributes:
        bounds: Bound of each quantity, by its label.
    """

    bounds: ClassVar[dict[str, Bound]]
    limit = 0.0  # each quantity has its own

    def __init__(self, material: RolloutMaterial):
        super().__init__(material)
        stored = [self.series(self._stored(start), start) for start in material.starts]
        self.limits = {
            label: max(bound.least, bound.slack * max(_largest(each[label])[0] for each in stored))
            for label, bound in self.bounds.items()
            if stored and label in stored[0]
        }

    @abstractmethod
    def series(self, positions: Tensor, start: Window) -> dict[str, Tensor]:
        """Quantities of frames (1 + T, N, D) by label, each (frames,); only those that apply to the scene."""

    def findings(self, predictor: StepModel) -> list[Finding]:
        """Measure the largest value of each quantity over all rollouts, and the first frame beyond its limit."""
        rolled = self.material.rolled(predictor)
        found = [self.series(each.positions, each.start) for each in rolled]
        return [self._worst(label, limit, [each[label] for each in found]) for label, limit in self.limits.items()]

    def first_beyond(self, positions: Tensor, start: Window) -> dict[str, int]:
        """Find the first frame of a rollout, counted from its start, beyond the limit of each quantity that exceeds it.

        Args:
            positions: The present of the start and the frames of the rollout, (1 + T, N, D).
            start: The window that it began with, with the stored frames that follow.
        """
        found = self.series(positions, start)
        places = {label: (found[label] > limit).nonzero() for label, limit in self.limits.items()}
        return {label: self.stride * int(beyond[0]) for label, beyond in places.items() if len(beyond)}

    def _stored(self, start: Window) -> Tensor:
        return torch.cat([start.present[None], start.future]).double()

    def _worst(self, label: str, limit: float, series: Sequence[Tensor]) -> Finding:
        value, place = max(_largest(each) for each in series)
        beyond = [int((each > limit).nonzero()[0]) for each in series if bool((each > limit).any())]
        detail = f"first beyond the limit at {self.where(min(beyond))}" if beyond else f"largest at {self.where(place)}"
        return self._finding(label, value, detail, limit)

    def where(self, place: int) -> str:
        """Name the frame of a place in a series."""
        return f"frame {place * self.stride} after the start"

    stride: ClassVar[int] = 1  # frames from one value of a series to the next


def _largest(series: Tensor) -> tuple[float, int]:
    """Return the largest value of a series and its place; infinity where one is not finite."""
    finite = torch.nan_to_num(series, nan=torch.inf)
    place = int(finite.argmax())
    return float(finite[place]), place
