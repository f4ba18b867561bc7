"""The frames that all checks share: unchanged and perturbed validation frames with their analytic fields."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor

from cconv.data.splits import evenly_spaced
from cconv.data.trajectory import Frame, Frames, Scene
from cconv.errors import DataError
from cconv.evaluation.checks.predictor import ModelPredictor, Predictor
from cconv.evaluation.checks.states import AS_IT_IS, State, stressed_states
from cconv.models.model import Model
from cconv.tasks.features import FluidState
from cconv.tasks.task import FieldTask

PLAIN_FRAMES = 20  # number of unchanged frames
STRESSED_FRAMES = 3  # number of frames that are perturbed: the first, the middle and the last one
SMALLEST_SCALE = 0.1  # share of the typical mean square that errors are divided by if the targets are smaller
SCALED = (  # the divisor in words
    "divided by the mean square of the target over the same particles, or by a tenth of the target's variance if that "
    "is larger; 1 is as bad as predicting 0"
)


@dataclass(frozen=True, kw_only=True)
class Probe:
    """A frame, unchanged or perturbed, with the field that a model should predict for it.

    Attributes:
        name: Name of the state.
        origin: The frame of the data that it was made from, in words.
        frame: Particles.
        scene: Their scene.
        target: Analytic field of its fluid particles, (N, C), float64.
        affected: Fluid particles whose errors count, (N,), bool.
        scale: Divisor of squared errors.
    """

    name: str
    origin: str
    frame: Frame
    scene: Scene
    target: Tensor
    affected: Tensor
    scale: float


@dataclass(frozen=True, kw_only=True)
class Material:
    """Frames of a scene for all checks and all models of a task.

    Attributes:
        task: Task of the models.
        scene: Scene of the frames.
        trajectory: A trajectory for checks over time.
        plain: Unchanged frames.
        few: Some frames to perturb, and the origin of each.
        typical: Variance of the target over the plain frames.
        fastest: Largest speed in them.
        reach: Largest distance that any model searches.
    """

    task: FieldTask
    scene: Scene
    trajectory: Frames
    plain: tuple[Probe, ...]
    few: tuple[tuple[Frame, str], ...]
    typical: float
    fastest: float
    reach: float

    def predictor(self, model: Model) -> ModelPredictor:
        """Return what checks test of a model."""
        return ModelPredictor(model)

    @property
    def counts(self) -> dict[str, int]:
        """Numbers of frames that are looked at, for a reader."""
        return {"plain_frames": len(self.plain), "stressed_frames": len(self.few)}

    @cached_property
    def stressed(self) -> tuple[Probe, ...]:
        """Return the few frames, each in every perturbed state."""
        kernel = self.task.kernel_at(self.scene.particle_spacing, self.scene.dim)
        options = {"typical_rate": self.typical**0.5, "fastest": self.fastest, "reach": self.reach}
        return tuple(
            self.answered(state, origin)
            for seed, (frame, origin) in enumerate(self.few)
            for state in stressed_states(frame, self.scene, kernel, **options, seed=seed)
        )

    def answered(self, state: State, origin: str) -> Probe:
        """Return a state of a frame with its analytic field."""
        target = self.task.field(self.task.state(state.frame, state.scene))
        return _probe(state, origin, target, self.typical)

    def scale(self, targets: Tensor) -> float:
        """Return the divisor of squared errors of particles with targets (N, C)."""
        return _scale(targets, self.typical)


def make_material(
    trajectories: Sequence[Frames], scene: Scene, task: FieldTask, reach: float | None = None
) -> Material:
    """Prepare the frames for the checks of a task in a scene.

    Args:
        trajectories: Trajectories that no model was trained on.
        scene: Their scene.
        task: What is asked.
        reach: Largest distance that a model searches; the kernel's support by default.

    Raises:
        DataError: If there is no frame.
    """
    stored = [(each, index) for each in trajectories for index in range(len(each))]
    if not stored:
        raise DataError("There is no validation frame to test stability on; give the split at least one.")
    places, few = (evenly_spaced(len(stored), count) for count in (PLAIN_FRAMES, STRESSED_FRAMES))
    frames = {place: _read(*stored[place]) for place in sorted({*places, *few})}
    chosen = [frames[place] for place in places]
    states = [task.state(frame, scene) for frame, _ in chosen]
    targets = [task.field(state) for state in states]
    typical = max(float(torch.cat(targets).var(dim=0, correction=0).mean()), _rounding(states, task))
    plain = [
        _probe(State(name=AS_IT_IS, frame=frame, scene=scene), origin, target, typical)
        for (frame, origin), target in zip(chosen, targets, strict=True)
    ]
    return Material(
        task=task,
        scene=scene,
        trajectory=trajectories[0],
        plain=tuple(plain),
        few=tuple(frames[place] for place in few),
        typical=typical,
        fastest=max(float(state.velocities.norm(dim=1).max()) for state in states),
        reach=max(reach or 0.0, states[0].kernel.support_radius),
    )


def squared_errors(predictor: Predictor, probe: Probe) -> Tensor:
    """Squared error of each fluid particle, mean over components, (N,), float64."""
    return (predictor.predict(probe.frame, probe.scene).double() - probe.target).square().mean(dim=1)


def relative_error(predictor: Predictor, probe: Probe) -> float:
    """Mean squared error of the affected particles by the probe's scale; 0 if there are none."""
    if not probe.affected.any():
        return 0.0
    return float(squared_errors(predictor, probe)[probe.affected].mean() / probe.scale)


def _read(trajectory: Frames, index: int) -> tuple[Frame, str]:
    """A frame, and where it is from."""
    return trajectory[index], f"trajectory {trajectory.name}, frame {trajectory.first_frame + index}"


def _rounding(states: Sequence[FluidState], task: FieldTask) -> float:
    """Return the square of the largest field that float32 cannot distinguish from 0."""
    density = max(float(state.densities.max()) for state in states)
    speed = max(float(state.velocities.norm(dim=1).max()) for state in states)
    smallest = task.magnitude(1e-4 * density, speed, states[0].kernel.smoothing_length)
    return max(smallest**2, torch.finfo(torch.float64).tiny)


def _probe(state: State, origin: str, target: Tensor, typical: float) -> Probe:
    affected = torch.ones(len(target), dtype=torch.bool) if state.affected is None else state.affected
    return Probe(
        name=state.name,
        origin=origin,
        frame=state.frame,
        scene=state.scene,
        target=target,
        affected=affected,
        scale=_scale(target[affected], typical),
    )


def _scale(targets: Tensor, typical: float) -> float:
    """Return the mean square of the targets of some particles, but at least a tenth of the typical one.

    So an error of 1 is as bad as predicting 0, unless the targets of the particles are too small to matter.
    """
    return max(float(targets.square().mean()) if len(targets) else 0.0, SMALLEST_SCALE * typical)
