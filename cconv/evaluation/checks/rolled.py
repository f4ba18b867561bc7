"""What checks of rollouts share: rollouts over whole trajectories and twice as long, short ones from other starts, and
limits from what is stored.
"""

from abc import abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial
from itertools import islice
from typing import ClassVar

import torch
from torch import Tensor

from cconv.data.splits import evenly_spaced
from cconv.data.trajectory import Frames, Scene
from cconv.data.window import Window, window_at
from cconv.evaluation.checks.check import Check, Finding
from cconv.evaluation.checks.starts import Start, other_starts
from cconv.models.model import Model
from cconv.neighbors import Edges, radius_graph
from cconv.rollout.rollout import Diverged, StepModel, rollout
from cconv.sph.kernels import AbstractKernel
from cconv.sph.operators import density
from cconv.tasks.task import StepTask

MOST_STARTS = 3  # trajectories that rollouts begin in
LONGER = 2  # rollouts are as many times as long as what is stored
SHORT = 20  # frames of a rollout from another start, or as many as are stored
SURFACE = 0.1  # share of the rest density that the sparsest hundredth lacks in fluid that does not fill its space


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
        others: Perturbed, mapped and later starts of one of the trajectories.
    """

    task: StepTask
    scene: Scene
    starts: tuple[Window, ...]
    others: tuple[Start, ...]
    _last: dict[int, tuple[StepModel, dict[object, Rolled]]] = field(default_factory=dict)

    def predictor(self, model: Model) -> Model:
        """Return what checks test of a model: the model itself, which they roll out."""
        return model

    @property
    def counts(self) -> dict[str, int]:
        """Numbers of what is looked at, for a reader: rollouts, and no perturbed frame."""
        return {"plain_frames": len(self.starts) + len(self.others), "stressed_frames": 0}

    def rolled(self, model: StepModel) -> tuple[Rolled, ...]:
        """Roll a model out from every start, once for all checks."""
        return tuple(
            self._once(model, place, partial(_roll, model, start, self.scene, LONGER * len(start.future)))
            for place, start in enumerate(self.starts)
        )

    def rolled_from(self, model: StepModel, other: Start) -> Rolled:
        """Roll a model out from one of the other starts, once for all checks."""
        return self._once(model, other.name, partial(_roll, model, other.window, other.scene, len(other.window.future)))

    def _once(self, model: StepModel, key: object, roll: Callable[[], Rolled]) -> Rolled:
        if id(model) not in self._last:
            self._last.clear()  # of the model before, whose checks are done
            self._last[id(model)] = model, {}
        rolled = self._last[id(model)][1]
        if key not in rolled:
            rolled[key] = roll()
        return rolled[key]


def make_rollout_material(trajectories: Sequence[Frames], scene: Scene, task: StepTask) -> RolloutMaterial:
    """Choose the starts of rollouts: the first windows of some trajectories, and others in the first of these."""
    chosen = [trajectories[place] for place in evenly_spaced(len(trajectories), MOST_STARTS)]
    present = task.history - 1
    starts = [window_at(each, present, task.history, len(each) - task.history) for each in chosen]
    others = other_starts(chosen[0], scene, task.history, min(SHORT, len(chosen[0]) - task.history))
    return RolloutMaterial(task=task, scene=scene, starts=tuple(starts), others=others)


def _roll(model: StepModel, start: Window, scene: Scene, length: int) -> Rolled:
    frames, ended = [start.present.double()], None
    try:
        for window in islice(rollout(model, start, scene), length):
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

    What follows the stored frames is compared too, but not in fluid with a free surface: once water splashes, the
    solver itself goes on to states that no stored frame shows.

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
        found = [self.series(each.positions[: self._num_compared(each.start)], each.start) for each in rolled]
        return [self._worst(label, limit, [each[label] for each in found]) for label, limit in self.limits.items()]

    def first_beyond(self, positions: Tensor, start: Window) -> dict[str, int]:
        """Find the first frame of a rollout, counted from its start, beyond the limit of each quantity that exceeds it.

        Args:
            positions: The present of the start and the frames of the rollout, (1 + T, N, D).
            start: The window that it began with, with the stored frames that follow.
        """
        found = self.series(positions[: self._num_compared(start)], start)
        places = {label: (found[label] > limit).nonzero() for label, limit in self.limits.items()}
        return {label: self.stride * int(beyond[0]) for label, beyond in places.items() if len(beyond)}

    def _num_compared(self, start: Window) -> int | None:
        """Number of frames that stored ones say something about; None for all."""
        return 1 + len(start.future) if has_free_surface(start, self.material.scene, self.material.task) else None

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


def has_free_surface(start: Window, scene: Scene, task: StepTask) -> bool:
    """Tell by the densities of a window's present whether the fluid leaves a part of its space empty."""
    kernel = task.kernel_at(scene.particle_spacing, scene.dim)
    edges = radius_graph(start.present.double(), kernel.support_radius, scene.box)
    return 1 - float(relative_densities(start, edges, kernel, scene).quantile(0.01)) > SURFACE


def relative_densities(start: Window, edges: Edges, kernel: AbstractKernel, scene: Scene) -> Tensor:
    """SPH densities of the M fluid particles among all particles of a window, (M,), rest density 1."""
    masses = start.masses.double()
    rest = float(masses[start.is_fluid].mean()) / scene.particle_spacing**scene.dim
    return density(masses, edges, kernel)[start.is_fluid] / rest
