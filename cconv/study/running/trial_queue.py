"""The queue of the trainings of a stage, which gives them to a pool, stops bad ones and records their outcomes."""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

from cconv.study.declared.configuration import TrainingConfig
from cconv.study.records.rungs import RungFile, RungTable
from cconv.study.records.trials import TrialFolder
from cconv.study.running.observer import Observer


@dataclass(frozen=True, kw_only=True)
class Job:
    """One training.

    Attributes:
        folder: Folder of its records.
        name: Name for messages.
        parameters: Hyperparameters.
        init_seed: Seed of the initial weights.
    """

    folder: Path
    name: str
    parameters: dict
    init_seed: int


def job_in(folder: TrialFolder, name: str, parameters: Mapping, init_seed: int) -> Job:
    """Make a training that is recorded in a folder.

    Raises:
        ConfigError: If the training in the folder began with other hyperparameters.
    """
    folder.check_begun_with(parameters)
    return Job(folder=folder.path.absolute(), name=name, parameters=dict(parameters), init_seed=init_seed)


class Judge(Protocol):
    """A rule that decides after every evaluation whether a training continues."""

    def goes_on(self, name: str, entry: Mapping) -> bool:
        """Tell whether a training continues after an evaluation."""


class NothingStops:
    """The rule without early stopping: only a training that diverged ends before the full budget."""

    def goes_on(self, name: str, entry: Mapping) -> bool:
        """Tell whether a training continues after an evaluation."""
        return not entry["diverged"]


class StopsByRungs:
    """The rule of ASHA: a trial stops if it is not among the best at its rung. The rungs are kept on disk.

    A trial also stops if its error is not finite or too large.

    Args:
        file: File of the rungs of all stages.
        stage: Stage of the trials.
        table: Rungs of the stage.
        give_up_above: Error above which a trial is always stopped; otherwise the first trial at a rung would always
            continue.
    """

    def __init__(self, file: RungFile, stage: str, table: RungTable, give_up_above: float = math.inf):
        self._file, self._stage, self._table, self._give_up_above = file, stage, table, give_up_above

    def goes_on(self, name: str, entry: Mapping) -> bool:
        """Tell whether a trial continues after an evaluation."""
        error = entry["valid_error"]
        if entry["diverged"] or error is None or not math.isfinite(error):
            return False
        within = self._table.record(name, entry["updates"], error)
        self._file.write(self._stage, self._table)
        return within and error <= self._give_up_above


class TrialQueue:
    """The queue of the trainings of a stage.

    Trainings that ended in an earlier run of the stage are skipped. One that was interrupted is first judged again by
    its log, because the kill may have come between an evaluation and the decision about it, and continues if it may.

    Args:
        jobs: The trainings in order; the next one is made only when a process is free.
        training: Settings of the trainings; one that has spent its full budget is completed.
        judge: Rule that decides after every evaluation whether a training continues.
        observers: Observers that are told about the trainings.
    """

    def __init__(self, jobs: Iterable[Job], training: TrainingConfig, judge: Judge, observers: Sequence[Observer]):
        self._jobs = iter(jobs)
        self._training = training
        self._judge, self._observers = judge, observers
        self._running: dict[str, Job] = {}

    def next(self) -> Job | None:
        """Return the next training to run; None if there is none left."""
        for job in self._jobs:
            folder = TrialFolder(job.folder)
            if folder.ended:
                continue
            self._running[job.name] = job
            for observer in self._observers:
                observer.on_trial_start(job.name, job.parameters)
            if self._goes_on_from(folder, job.name):
                return job
        return None

    def on_result(self, name: str, entry: Mapping) -> bool:
        """Tell the observers about an evaluation; return whether the training continues."""
        for observer in self._observers:
            observer.on_trial_result(name, entry)
        return self._judge.goes_on(name, entry)

    def on_end(self, name: str, outcome: str, reason: str = "") -> None:
        """Record the outcome of a training."""
        TrialFolder(self._running.pop(name).folder).finish(outcome, reason)
        for observer in self._observers:
            observer.on_trial_end(name, outcome, reason)

    def outcome_after(self, entry: Mapping) -> str:
        """Return the outcome of a training that ends after an evaluation."""
        if entry["diverged"]:
            return "diverged"
        return "completed" if self._training.is_spent(entry) else "stopped"

    def _goes_on_from(self, folder: TrialFolder, name: str) -> bool:
        for entry in folder.log():
            if not self.on_result(name, entry) or self._training.is_spent(entry):
                self.on_end(name, self.outcome_after(entry))
                return False
        return True
