"""How trials end, from Ray into our records and to the observer."""

from ray import tune

from cconv.study.observer import Observer
from cconv.study.records import TrialFolder


class Recorder(tune.Callback):
    """A Ray callback that writes the outcome of every trial into its own folder.

    Args:
        observer: Sees the trials as they run.
        job_of: A trial's name and Ray's parameters to its `Job`.
        stage: Stage of the trials.
        max_updates: Full budget; a trial that ends before it was stopped.
    """

    def __init__(self, observer: Observer, job_of, stage: str, max_updates: int):
        self._observer, self._job_of, self._stage, self._max_updates = observer, job_of, stage, max_updates

    def __getstate__(self) -> dict:
        """Nothing: Ray pickles callbacks to restore a run from its own files, which we never do."""
        return {}

    def on_trial_start(self, iteration, trials, trial, **info) -> None:
        """A trial begins."""
        self._observer.on_trial_start(str(trial), self._job(trial).parameters)

    def on_trial_result(self, iteration, trials, trial, result, **info) -> None:
        """A trial was evaluated."""
        shown = result | {"valid_normalized_mse": None} if result["diverged"] else result
        self._observer.on_trial_result(str(trial), shown)

    def on_trial_complete(self, iteration, trials, trial, **info) -> None:
        """A trial reached its budget, was stopped, or diverged."""
        last = trial.last_result
        full = last["updates"] >= self._max_updates
        self._end(trial, "diverged" if last["diverged"] else "completed" if full else "stopped", "")

    def on_trial_error(self, iteration, trials, trial, **info) -> None:
        """A trial raised, or its process died."""
        self._end(trial, "failed", TrialFolder(self._job(trial).folder).reason or "its process died")

    def _job(self, trial):
        return self._job_of(str(trial), trial.config)

    def _end(self, trial, outcome: str, reason: str) -> None:
        job = self._job(trial)
        folder = TrialFolder(job.folder)
        if not folder.started:  # it failed before it could say what it is
            known = {"stage": self._stage, "parameters": job.parameters, "init_seed": job.init_seed}
            folder.start(known | {"num_parameters": None})
        folder.finish(outcome, reason)
        self._observer.on_trial_end(str(trial), outcome, reason)
