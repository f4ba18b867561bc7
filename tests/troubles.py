"""A problem whose trainings fail, fill the disk, die or hang, for tests of what a pool makes of it."""

import errno
import os
import time
from dataclasses import dataclass

from conftest import SMOKE

from cconv.study.declared.study_file import StudyConfig
from cconv.study.records.trials import TrialFolder
from cconv.study.running.problem import Problem, load_problem, open_study_data, study_task, with_data_path
from cconv.study.running.trial_queue import Job, NothingStops, TrialQueue
from cconv.study.studies import load_study

FULL = 2


@dataclass(frozen=True, kw_only=True)
class TroubledProblem(Problem):
    """A problem whose models bring trouble that the number of their initial weights names."""

    def build_model(self, network, init_seed):
        troubles = {1: self.error, 2: self.full_disk, 3: self.death, 4: self.hang}
        troubles.get(init_seed, int)()
        return super().build_model(network, init_seed)

    def error(self):
        raise ValueError("no such model")

    def full_disk(self):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), "log.jsonl")

    def death(self):
        os._exit(1)

    def hang(self):
        time.sleep(1000)


class BrokenJudge:
    """A judge that cannot write its rungs."""

    def goes_on(self, name, entry):
        raise OSError(errno.ENOSPC, "rungs.json")


def study_of(data, *settings) -> StudyConfig:
    """The smoke study with trainings of two updates."""
    overrides = [f"training.updates={FULL}", "training.evaluate_every=1", "search.grace_updates=1", *settings]
    return with_data_path(load_study(SMOKE, [*overrides, "search.concurrency=2"]), str(data))


def troubled_problem(data) -> TroubledProblem:
    """What the trainings of `study_of` share."""
    study = study_of(data)
    dataset = open_study_data(study.data, study.seeds.data)
    return TroubledProblem(**vars(load_problem(study, dataset, study_task(study, dataset.scene))))


def jobs_in(folder, seeds) -> list[Job]:
    """A job of each number of initial weights."""
    return [Job(folder=folder / f"trial_{seed}", name=f"trial_{seed}", parameters={}, init_seed=seed) for seed in seeds]


def end_of(folder, seed) -> tuple[str, str] | None:
    """How a job ended and why; None if it did not."""
    trial = TrialFolder(folder / f"trial_{seed}")
    return (trial.read().outcome, trial.read().reason) if trial.ended else None


def trained_in(pool, study, folder, seeds, judge=None) -> dict:
    """Train models of some initial weights in a pool; gives how each ended and why."""
    pool.run(TrialQueue(jobs_in(folder, seeds), study.training, judge or NothingStops(), []), "random", study.training)
    return {seed: end_of(folder, seed) for seed in seeds}
