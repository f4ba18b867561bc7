"""The interface of pools, which train the jobs of a stage."""

from typing import Protocol

from cconv.study.declared.configuration import TrainingConfig
from cconv.study.running.trial_queue import TrialQueue


class Pool(Protocol):
    """A pool of processes, or a single process, that trains the jobs of queues."""

    def run(self, queue: TrialQueue, stage: str, training: TrainingConfig) -> None:
        """Train every job of a queue to the full budget of `training`, unless it is stopped before.

        Raises:
            ConfigError: If the disk is full; the records stay, and the stage can be resumed.
        """
