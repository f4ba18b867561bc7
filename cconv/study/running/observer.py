"""Who watches a study run."""

from collections.abc import Mapping, Sequence
from typing import Protocol


class Observer(Protocol):
    """Sees a study as it runs; the command line draws it."""

    def on_data(self, findings: Sequence[str]) -> None:
        """The data were read; each line names something in them that does not make sense."""

    def on_stage(self, stage: str, num_trials: int, max_updates: int) -> None:
        """A stage begins."""

    def on_trial_start(self, trial: str, parameters: Mapping) -> None:
        """A trial begins."""

    def on_trial_result(self, trial: str, entry: Mapping) -> None:
        """A trial was evaluated."""

    def on_trial_end(self, trial: str, outcome: str, reason: str) -> None:
        """A trial ended."""
