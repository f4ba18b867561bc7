"""Examples: what a training learns from, sample by sample."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import torch

from cconv.models.model import Model
from cconv.tasks.samples import Sample, WindowSamples, make_step_sample
from cconv.training.augmentation import Augmentation
from cconv.training.unroll import Pushforward, pushed


class Examples(Protocol):
    """Samples to learn from, which may differ from update to update."""

    def __len__(self) -> int:
        """Number of samples of an epoch."""

    def draw(self, index: int, update: int, model: Model) -> Sample:
        """Return one of them, as it is seen in an update of a model."""


@dataclass(frozen=True)
class StoredExamples:
    """Samples that are always the same.

    Attributes:
        samples: The samples.
    """

    samples: Sequence[Sample]

    def __len__(self) -> int:
        return len(self.samples)

    def draw(self, index: int, update: int, model: Model) -> Sample:
        """Return a sample."""
        return self.samples[index]


@dataclass(frozen=True)
class AugmentedExamples:
    """Samples of windows that are changed at random, in another way in each update, but the same after a restart.

    Attributes:
        samples: Samples of the windows.
        augmentation: What changes a window.
        pushforward: How far the model's own rollout goes on from there.
        seed: Seed of the changes, together with update and index.
    """

    samples: WindowSamples
    augmentation: Augmentation
    pushforward: Pushforward
    seed: int

    def __len__(self) -> int:
        return len(self.samples)

    def draw(self, index: int, update: int, model: Model) -> Sample:
        """Return the sample of a window that was changed for this update."""
        state = np.random.SeedSequence([self.seed, update, index]).generate_state(1, np.uint64)
        generator = torch.Generator().manual_seed(int(state[0] >> 1))
        scene = self.samples.scene
        window = self.augmentation(self.samples.window(index), scene, generator)
        steps = min(self.pushforward.steps(update, generator), len(window.future) - 1)
        window = pushed(model, window, scene, steps)
        return make_step_sample(window, scene, self.samples.task, model.config.features)
