"""What checks of other starts share: the distance of a rollout from what is expected, relative to the fluid's way."""

import math
from collections.abc import Iterable

import torch
from torch import Tensor

from cconv.domain import Box
from cconv.evaluation.checks.check import Check, Finding
from cconv.evaluation.checks.rolled import RolloutMaterial
from cconv.evaluation.checks.starts import Start
from cconv.rollout.rollout import StepModel


class StartCheck(Check[RolloutMaterial, StepModel]):
    """A check of rollouts from other starts than the first stored frames."""

    def starts(self, names: Iterable[str]) -> list[Start]:
        """Return the starts with these names."""
        return [start for start in self.material.others if start.name in names]

    def distance(self, label: str, start: Start, predictor: StepModel, expected: Tensor) -> Finding:
        """Measure how far the fluid of a rollout is from expected frames, as a share of the way that it goes.

        The value is the largest over the frames, and not finite if the rollout or the expected frames end early.

        Args:
            label: Label of the finding.
            start: The start.
            predictor: The model.
            expected: The start and the frames after it, (1 + T, N, D), in the start's scene.
        """
        rolled, frames = self.material.rolled_from(predictor, start), 1 + len(start.window.future)
        if min(len(rolled.positions), len(expected)) < frames:
            return self._finding(label, math.inf, rolled.ended or "what it is compared with diverged")
        fluid = start.window.is_fluid
        apart = distances(rolled.positions[:, fluid], expected[:frames, fluid], start.scene.box)
        share = apart / way(start)
        return self._finding(label, share.max(), f"largest at frame {int(share.argmax())} after the start")


def stored(start: Start) -> Tensor:
    """The present and the stored frames after it, (1 + T, N, D), float64."""
    return torch.cat([start.window.present[None].double(), start.window.future.double()])


def way(start: Start) -> float:
    """Root mean square distance that the stored fluid gets away from where it begins, at least a particle spacing."""
    frames = stored(start)[:, start.window.is_fluid]
    return max(float(distances(frames, frames[:1], start.scene.box).max()), start.scene.particle_spacing)


def distances(positions: Tensor, others: Tensor, box: Box) -> Tensor:
    """Root mean square distance of the particles in each frame, (T,), of frames (T, N, D)."""
    return box.displacement(positions, others).square().sum(dim=2).mean(dim=1).sqrt()
