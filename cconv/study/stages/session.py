"""The session: everything that the stages of a running study share."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from zlib import crc32

import numpy as np
import torch

from cconv.data.dataset import Dataset
from cconv.devices import CPU
from cconv.errors import ConfigError
from cconv.models.checkpoint import load_model
from cconv.models.model import Model
from cconv.study.declared.domains import SearchSpace
from cconv.study.declared.search_space import load_space
from cconv.study.declared.stage import reads_of
from cconv.study.declared.study_file import StudyConfig
from cconv.study.records.run_folder import RunFolder
from cconv.study.records.trials import TrialRecord
from cconv.study.running.counted_costs import CostCounter
from cconv.study.running.observer import Observer
from cconv.study.running.pool import Pool
from cconv.study.running.problem import Problem

Progress = Callable[[Iterable, str], Iterable]


@dataclass(frozen=True, kw_only=True)
class Session:
    """A study that runs in its folder.

    Attributes:
        study: The study.
        space: Its search space.
        dataset: Its data.
        problem: Scene, task, training and validation samples.
        run: Where everything is recorded.
        observer: Is told about the trials as they run.
        mirror: Copies the trials of searches to Optuna's storage.
        start_pool: Returns the pool that trains the jobs of a stage; the first call starts it.
        count_cost: Counts the cost of a configuration, before anything is built.
        progress: Wraps an iterable to show progress, given a label.
        useless_error: Error of predicting the training mean on the validation split.
        device: Where models are compared and timed.
    """

    study: StudyConfig
    space: SearchSpace
    dataset: Dataset
    problem: Problem
    run: RunFolder
    observer: Observer
    mirror: Observer
    start_pool: Callable[[], Pool]
    count_cost: CostCounter
    progress: Progress
    useless_error: float
    device: torch.device = CPU

    def load_model(self, folder: Path) -> Model:
        """Load a model onto the device of the study."""
        return load_model(folder, device=self.device)

    def read(self, stage: str, *kinds: str) -> list[TrialRecord]:
        """Read the records of the stages that a stage reads, or only of those of the named kinds."""
        stages = self.study.stages
        names = [name for name in reads_of(stages, stage) if not kinds or stages[name].kind in kinds]
        return [record for name in names for record in self.run.trials_of(name)]

    def seed_of(self, stage: str) -> int:
        """Return the seed of a stage's random draws; streams of different stages and studies never overlap."""
        return int(np.random.SeedSequence([self.study.seeds.search, crc32(stage.encode())]).generate_state(1)[0])

    def space_of(self, stage: str) -> SearchSpace:
        """Return the space of the study, or the one that an earlier stage narrowed for this stage."""
        refined = self.study.stages[stage].space_from
        if refined is None:
            return self.space
        return load_space(self.run.path / "stages" / f"{refined}.toml", self.study)

    def affordable(self, parameters: Mapping) -> bool:
        """Tell whether a configuration is below the space's caps on cost, and possible in this scene."""
        caps = self.space.caps
        try:
            return not caps or all(getattr(self.count_cost(parameters), name) <= cap for name, cap in caps.items())
        except ConfigError:
            return False

    def observers(self, mirrored: bool) -> Sequence[Observer]:
        """Return the observers that are told about the trials of a stage."""
        return [self.observer, self.mirror] if mirrored else [self.observer]
