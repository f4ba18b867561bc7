"""What all stages of a run share."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from zlib import crc32

import numpy as np

from cconv.data.dataset import Dataset
from cconv.errors import ConfigError
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
        observer: Sees the trials as they run.
        mirror: Repeats searches in Optuna's storage.
        start_pool: Gives what trains the jobs of a stage; starts it at the first call.
        count_cost: Counts the cost of a configuration, before anything is built.
        progress: Wraps an iterable to show progress, given a label.
        useless_error: What predicting the training mean scores on the validation split.
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

    def read(self, stage: str, *kinds: str) -> list[TrialRecord]:
        """Records of the stages that a stage reads, of some kinds only if any are named."""
        stages = self.study.stages
        names = [name for name in reads_of(stages, stage) if not kinds or stages[name].kind in kinds]
        return [record for name in names for record in self.run.trials_of(name)]

    def seed_of(self, stage: str) -> int:
        """Seed of a stage's draws: streams of stages and studies do not overlap, and no stage shifts another's."""
        return int(np.random.SeedSequence([self.study.seeds.search, crc32(stage.encode())]).generate_state(1)[0])

    def space_of(self, stage: str) -> SearchSpace:
        """The study's space, or the one that an earlier stage refined for this one."""
        refined = self.study.stages[stage].space_from
        if refined is None:
            return self.space
        return load_space(self.run.path / "stages" / f"{refined}.toml", self.study)

    def affordable(self, parameters: Mapping) -> bool:
        """Whether a configuration is below the space's caps on cost, and possible in this scene."""
        caps = self.space.caps
        try:
            return not caps or all(getattr(self.count_cost(parameters), name) <= cap for name, cap in caps.items())
        except ConfigError:
            return False

    def observers(self, mirrored: bool) -> Sequence[Observer]:
        """Who sees the trials of a stage."""
        return [self.observer, self.mirror] if mirrored else [self.observer]
