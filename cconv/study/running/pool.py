"""What trains the jobs of a stage."""

from typing import Protocol

from cconv.study.declared.configuration import TrainingConfig
from cconv.study.running.trial_queue import TrialQueue


class Pool(Protocol):
    """Trains the jobs of queues, some at once or one after another."""

    def run(self, queue: TrialQueue, stage: str, training: TrainingConfig) -> None:
        """Train every job of a queue that does not stop earlier to the full budget of `training`.

        Raises:
            ConfigError: If the disk is full; what was recorded stays, and the stage can be resumed.
        """
