"""The interface of observers, which are told about the trainings of a study as they run."""

from collections.abc import Mapping, Sequence
from typing import Protocol

from cconv.study.declared.configuration import TrainingConfig


class Observer(Protocol):
    """An observer of a running study, e.g. the display of the command line."""

    def on_data(self, findings: Sequence[str]) -> None:
        """Take note that the data were read; each finding names something implausible in them."""

    def on_stage(self, stage: str, num_trials: int, training: TrainingConfig) -> None:
        """Take note that a stage begins, with so many trainings of some settings."""

    def on_trial_start(self, trial: str, parameters: Mapping) -> None:
        """Take note that a trial begins."""

    def on_trial_result(self, trial: str, entry: Mapping) -> None:
        """Take note of an evaluation of a trial."""

    def on_trial_end(self, trial: str, outcome: str, reason: str) -> None:
        """Take note that a trial ended."""
