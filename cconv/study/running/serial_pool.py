"""Trainings one after another in this process, without Ray."""

from contextlib import closing

from cconv.ops.workers import torch_threads
from cconv.study.declared.configuration import TrainingConfig
from cconv.study.declared.study_file import StudyConfig
from cconv.study.running.problem import Problem
from cconv.study.running.recorded_training import DISK_FULL, disk_is_full, train_recorded
from cconv.study.running.trial_queue import Job, TrialQueue


class SerialPool:
    """A `Pool` of this process, whose records are equal to the last bit to those of Ray with one job at a time.

    If a training hangs or its process dies, the run ends too. When the run is resumed, a training that hung has failed.

    Args:
        study: The study.
        problem: Scene, task and samples.
    """

    def __init__(self, study: StudyConfig, problem: Problem):
        self._study, self._problem = study, problem

    def run(self, queue: TrialQueue, stage: str, training: TrainingConfig) -> None:
        """Train every job of a queue to the full budget of `training`, unless it is stopped before.

        Raises:
            ConfigError: If the disk is full; the records stay, and the stage can be resumed.
        """
        with torch_threads(1):  # as in a process of Ray; the last bits of sums depend on the number of threads
            while (job := queue.next()) is not None:
                queue.on_end(job.name, *self._train(job, queue, stage, training))

    def _train(self, job: Job, queue: TrialQueue, stage: str, training: TrainingConfig) -> tuple[str, str]:
        """Train a job and return its outcome and the reason for it."""
        with closing(train_recorded(job, stage, training, self._study, self._problem)) as reports:
            for entry, outcome, reason in reports:
                if outcome == DISK_FULL:
                    raise disk_is_full(job, reason)
                if outcome is not None:
                    return outcome, reason
                if not queue.on_result(job.name, entry):
                    break
        return queue.outcome_after(entry), ""
