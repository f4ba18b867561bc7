"""Trainings one after another in this process, without Ray."""

from contextlib import closing

from cconv.ops.workers import torch_threads
from cconv.study.declared.configuration import TrainingConfig
from cconv.study.declared.study_file import StudyConfig
from cconv.study.running.problem import Problem
from cconv.study.running.recorded_training import DISK_FULL, disk_is_full, train_recorded
from cconv.study.running.trial_queue import Job, TrialQueue


class SerialPool:
    """A `Pool` that leaves the records of a Ray that trains one job at a time, to the last bit.

    A training whose process dies or hangs takes the run with it; when the run is resumed, one that hung has failed.

    Args:
        study: The study.
        problem: What all trainings share.
    """

    def __init__(self, study: StudyConfig, problem: Problem):
        self._study, self._problem = study, problem

    def run(self, queue: TrialQueue, stage: str, training: TrainingConfig) -> None:
        """Train every job of a queue that does not stop earlier to the full budget of `training`.

        Raises:
            ConfigError: If the disk is full; what was recorded stays, and the stage can be resumed.
        """
        with torch_threads(1):  # as a process of a pool, on whose number the last bits of sums depend
            while (job := queue.next()) is not None:
                queue.on_end(job.name, *self._train(job, queue, stage, training))

    def _train(self, job: Job, queue: TrialQueue, stage: str, training: TrainingConfig) -> tuple[str, str]:
        """Outcome of a job, and the reason for it."""
        with closing(train_recorded(job, stage, training, self._study, self._problem)) as reports:
            for entry, outcome, reason in reports:
                if outcome == DISK_FULL:
                    raise disk_is_full(job, reason)
                if outcome is not None:
                    return outcome, reason
                if not queue.on_result(job.name, entry):
                    break
        return queue.outcome_after(entry), ""
