"""How trials end, from Ray into our records and to the observer."""

from collections.abc import Callable

from ray import tune

from cconv.study.observer import Observer
from cconv.study.records import TrialFolder


class Recorder(tune.Callback):
    """A Ray callback that writes the outcome of every trial into its own folder.

    Args:
        observer: Sees the trials as they run.
        folder_of: Folder of a trial by name.
        max_updates: Full budget; a trial that ends before it was stopped.
    """

    def __init__(self, observer: Observer, folder_of: Callable[[str], TrialFolder], max_updates: int):
        self._observer, self._folder_of, self._max_updates = observer, folder_of, max_updates

    def __getstate__(self) -> dict:
        """Nothing: Ray pickles callbacks to restore a run from its own files, which we never do."""
        return {}

    def on_trial_start(self, iteration, trials, trial, **info) -> None:
        """A trial begins."""
        self._observer.on_trial_start(str(trial), trial.config)

    def on_trial_result(self, iteration, trials, trial, result, **info) -> None:
        """A trial was evaluated."""
        self._observer.on_trial_result(str(trial), result)

    def on_trial_complete(self, iteration, trials, trial, **info) -> None:
        """A trial reached its budget, was stopped, or diverged."""
        last = trial.last_result
        full = last["updates"] >= self._max_updates
        self._end(trial, "diverged" if last["diverged"] else "completed" if full else "stopped", "")

    def on_trial_error(self, iteration, trials, trial, **info) -> None:
        """A trial raised, or its process died."""
        lines = str(trial.get_error() or "its process died").strip().splitlines()
        self._end(trial, "failed", lines[-1] if lines else "")

    def _end(self, trial, outcome: str, reason: str) -> None:
        self._folder_of(str(trial)).finish(outcome, reason)
        self._observer.on_trial_end(str(trial), outcome, reason)
