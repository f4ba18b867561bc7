"""Unrolling: a model learns from states that its own rollout leads to."""

from dataclasses import dataclass
from itertools import islice

import torch

from cconv.data.trajectory import Scene
from cconv.data.window import Window
from cconv.rollout.rollout import Diverged, StepModel, rollout


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
