"""Examples: what a training learns from, sample by sample."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np
import torch

from cconv.data.window import Window, join_windows, joinable
from cconv.models.model import Model
from cconv.tasks.samples import Sample, WindowSamples, join_samples, make_step_sample
from cconv.training.augmentation import Augmentation
from cconv.training.unroll import Pushforward, pushed


class Examples(Protocol):
    """Samples to learn from, which may differ from update to update."""

    def __len__(self) -> int:
        """Number of samples of an epoch."""

    def draw(
        self, indices: Sequence[int], update: int, model: Model, steps: int = 1, share: float = 0.0
    ) -> list[Sample]:
        """Return some of them, as they are seen in an update of a model, in as few graphs as are sensible.

        Args:
            indices: Indices of the samples.
            update: Number of the update.
            model: The model.
            steps: Steps that are learned at once; as many following frames are known, where they are stored.
            share: Share of the training's budget that is spent before.
        """


@dataclass(frozen=True)
class StoredExamples:
    """Samples that are always the same.

    Attributes:
        samples: The samples.
    """

    samples: Sequence[Sample]

    def __len__(self) -> int:
        return len(self.samples)

    def draw(
        self, indices: Sequence[int], update: int, model: Model, steps: int = 1, share: float = 0.0
    ) -> list[Sample]:
        """Return samples; arguments as of `Examples.draw`."""
        if isinstance(self.samples, WindowSamples):
            windows = [self.samples.window(index).to(model.home) for index in indices]
            return _step_samples(windows, self.samples, model, steps)
        return join_samples([self.samples[index].to(model.home) for index in indices])


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

    def draw(
        self, indices: Sequence[int], update: int, model: Model, steps: int = 1, share: float = 0.0
    ) -> list[Sample]:
        """Return samples of windows that were changed for this update; arguments as of `Examples.draw`."""
        scene, changed = self.samples.scene, [self._changed(index, update, share) for index in indices]
        windows = [window.to(model.home) for window, _ in changed]
        windows = pushed(model, windows, scene, [count for _, count in changed])
        return _step_samples(windows, self.samples, model, steps)

    def _changed(self, index: int, update: int, share: float) -> tuple[Window, int]:
        """A window that was changed for an update, and how many steps it is to be pushed."""
        state = np.random.SeedSequence([self.seed, update, index]).generate_state(1, np.uint64)
        generator = torch.Generator().manual_seed(int(state[0] >> 1))
        window = self.augmentation(self.samples.window(index), self.samples.scene, generator)
        return window, min(self.pushforward.steps(share, generator), len(window.future) - 1)


def _step_samples(windows: Sequence[Window], of: WindowSamples, model: Model, steps: int) -> list[Sample]:
    """Samples of windows in as few graphs as are sensible; no frame is known beyond the steps that are learned."""
    known = [replace(window, future=window.future[:steps]) for window in windows]
    joined = (join_windows([known[number] for number in group]) for group in joinable(known))
    return [make_step_sample(window, of.scene, of.task, model.config.features) for window in joined]
