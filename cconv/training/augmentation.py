"""Augmentations: changes of the windows that a model learns from."""

from dataclasses import dataclass, replace
from typing import Protocol

import torch

from cconv.data.trajectory import Scene
from cconv.data.window import Window


class Augmentation(Protocol):
    """Changes a window at random before its sample is made."""

    def __call__(self, window: Window, scene: Scene, generator: torch.Generator) -> Window:
        """The window to learn from."""


@dataclass(frozen=True)
class RandomWalkNoise:
    """Random walk of the velocities of fluid particles, so that a model learns to undo errors of its own rollout.

    The velocity between each two frames of the past gets a normal increment more than the one before; the increments
    add up to the standard deviation of the last velocity. The oldest frame stays, positions follow the velocities, and
    the future moves with the present, so that the target corrects the last velocity. Source: Sanchez-Gonzalez et al.,
    "Learning to Simulate Complex Physics with Graph Networks" (ICML 2020), appendix B.2.

    Attributes:
        deviation: Standard deviation of each component of the last velocity's noise, particle spacings per frame.
    """

    deviation: float

    def __call__(self, window: Window, scene: Scene, generator: torch.Generator) -> Window:
        """The window with noise."""
        positions = window.positions.double()
        steps = len(positions) - 1
        increments = torch.randn(steps, *positions.shape[1:], generator=generator, dtype=torch.float64)
        increments *= self.deviation * scene.particle_spacing / steps**0.5 * window.is_fluid[:, None]
        walk = increments.cumsum(0).cumsum(0)
        past = torch.cat([positions[:1], positions[1:] + walk])
        box = scene.box
        return replace(window, positions=box.wrap(past), future=box.wrap(window.future.double() + walk[-1]))
