"""The trainings of a stage, one after another: handed out, judged at the rungs, ended. Knows nothing of Ray."""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

from cconv.study.records.rungs import RungFile, RungTable
from cconv.study.records.trials import TrialFolder
from cconv.study.running.observer import Observer


@dataclass(frozen=True, kw_only=True)
class Job:
    """One training.

    Attributes:
        folder: Where it is recorded.
        name: Name to show.
        parameters: Hyperparameters.
        init_seed: Seed of the initial weights.
    """

    folder: Path
    name: str
    parameters: dict
    init_seed: int


def job_in(folder: TrialFolder, name: str, parameters: Mapping, init_seed: int) -> Job:
    """A training that is recorded in a folder.

    Raises:
        ConfigError: If the folder's training was begun with other hyperparameters.
    """
    folder.check_begun_with(parameters)
    return Job(folder=folder.path.absolute(), name=name, parameters=dict(parameters), init_seed=init_seed)


class Judge(Protocol):
    """Decides after every evaluation whether a training goes on."""

    def goes_on(self, name: str, entry: Mapping) -> bool:
        """Whether a training goes on after an evaluation."""


class NothingStops:
    """Judge of trainings that all go to the end."""

    def goes_on(self, name: str, entry: Mapping) -> bool:
        """Whether a training goes on after an evaluation."""
        return not entry["diverged"]


class StopsByRungs:
    """Judge that stops a trial whose error is not finite, hopeless, or beaten at its rung, and keeps the rungs on disk.

    Args:
        file: File of the rungs of all stages.
        stage: Stage of the trials.
        table: Its rungs.
        give_up_above: Error at which a trial is stopped whatever the rung holds; the first trial at a rung would
            otherwise always go on.
    """

    def __init__(self, file: RungFile, stage: str, table: RungTable, give_up_above: float = math.inf):
        self._file, self._stage, self._table, self._give_up_above = file, stage, table, give_up_above

    def goes_on(self, name: str, entry: Mapping) -> bool:
        """Whether a trial goes on after an evaluation."""
        error = entry["valid_error"]
        if entry["diverged"] or error is None or not math.isfinite(error):
            return False
        within = self._table.record(name, entry["updates"], error)
        self._file.write(self._stage, self._table)
        return within and error <= self._give_up_above


class TrialQueue:
    """Trainings of a stage.

    Those that ended in an earlier run of the stage are passed over. One that was cut short is judged again by what it
    logged, as the kill may have come between an evaluation and its consequence, and handed out if it goes on.

    Args:
        jobs: The trainings in their order; each is asked for only when a place is free.
        full_updates: Full budget; a training that reaches it is completed.
        judge: Decides after every evaluation whether a training goes on.
        observers: See the trainings as they run.
    """

    def __init__(self, jobs: Iterable[Job], full_updates: int, judge: Judge, observers: Sequence[Observer]):
        self._jobs = iter(jobs)
        self.full_updates = full_updates
        self._judge, self._observers = judge, observers
        self._running: dict[str, Job] = {}

    def next(self) -> Job | None:
        """The next training to run; None if there is none left."""
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
        """Take an evaluation; whether the training goes on."""
        for observer in self._observers:
            observer.on_trial_result(name, entry)
        return self._judge.goes_on(name, entry)

    def on_end(self, name: str, outcome: str, reason: str = "") -> None:
        """Record how a training ended."""
        TrialFolder(self._running.pop(name).folder).finish(outcome, reason)
        for observer in self._observers:
            observer.on_trial_end(name, outcome, reason)

    def outcome_after(self, entry: Mapping) -> str:
        """How a training ends that does not go on after an evaluation."""
        if entry["diverged"]:
            return "diverged"
        return "completed" if entry["updates"] >= self.full_updates else "stopped"

    def _goes_on_from(self, folder: TrialFolder, name: str) -> bool:
        for entry in folder.log():
            if not self.on_result(name, entry) or entry["updates"] >= self.full_updates:
                self.on_end(name, self.outcome_after(entry))
                return False
        return True
