"""Ray's ASHA and Optuna search with the corrections that a trustworthy record needs.

Ray's scheduler never stops a trial whose error is not finite and leaves no record of its rungs; its Optuna search tells
Optuna that stopped trials are complete. Source of the algorithm: Li et al., "A System for Massively Parallel
Hyperparameter Tuning" (MLSys 2020), algorithm 2 (the stopping variant).
"""

from pathlib import Path

from ray.tune.schedulers import ASHAScheduler
from ray.tune.search.optuna import OptunaSearch

from cconv.study.records import read_json, write_json


class RecordedASHA(ASHAScheduler):
    """ASHA that stops diverged trials and writes its rungs to a file after every result.

    Args:
        rungs_file: JSON file of the rungs: for each stage a list of {"updates", "recorded": {trial: error}}.
        stage: Stage whose rungs these are.
        max_updates: Full budget.
        grace_updates: First rung.
        reduction_factor: Rungs stand at ``grace_updates · reduction_factor^k``.
        metric: Name of the error in a result.
        give_up_above: Error at which a trial is stopped whatever the rung holds; the first trial at a rung would
            otherwise always pass.
    """

    def __init__(
        self,
        rungs_file: Path,
        stage: str,
        *,
        max_updates: int,
        grace_updates: int,
        reduction_factor: int,
        metric: str,
        give_up_above: float,
    ):
        super().__init__(
            time_attr="updates",
            metric=metric,
            mode="min",
            max_t=max_updates,
            grace_period=grace_updates,
            reduction_factor=reduction_factor,
            brackets=1,
        )
        self._rungs_file, self._stage = rungs_file, stage
        self._give_up_above = give_up_above
        self._names: dict[str, str] = {}

    def on_trial_add(self, tune_controller, trial) -> None:
        """Remember the name that our records know the trial by."""
        self._names[trial.trial_id] = str(trial)
        super().on_trial_add(tune_controller, trial)

    def on_trial_result(self, tune_controller, trial, result: dict) -> str:
        """Stop a diverged or hopeless trial, else decide by the rung; record the rungs."""
        if result["diverged"]:
            return self.STOP
        decision = super().on_trial_result(tune_controller, trial, result)
        self._write()
        return self.STOP if result[self._metric] > self._give_up_above else decision

    def on_trial_complete(self, tune_controller, trial, result: dict) -> None:
        """Keep a diverged trial out of the rungs; its placeholder error is no measurement."""
        if not result["diverged"]:
            super().on_trial_complete(tune_controller, trial, result)
            self._write()

    def _write(self) -> None:
        # Ray keeps errors to be maximised, so a minimised one stands there with its sign turned.
        rungs = [
            {"updates": int(updates), "recorded": {self._names[trial]: -value for trial, value in recorded.items()}}
            for updates, recorded in self._brackets[0]._rungs
        ]
        stages = read_json(self._rungs_file) if self._rungs_file.is_file() else {}
        write_json(self._rungs_file, stages | {self._stage: sorted(rungs, key=lambda rung: rung["updates"])})


class RungAwareOptunaSearch(OptunaSearch):
    """Optuna search that tells PRUNED, with the last value, for a trial that did not reach the full budget."""

    def __init__(self, *args, max_updates: int, **kwargs):
        super().__init__(*args, **kwargs)
        self._max_updates = max_updates

    def on_trial_result(self, trial_id: str, result: dict) -> None:
        """Report an error at its number of updates, not at Ray's count of reports."""
        self._ot_trials[trial_id].report(result[self.metric], int(result["updates"]))

    def on_trial_complete(self, trial_id: str, result: dict | None = None, error: bool = False) -> None:
        """Report the last error; PRUNED if diverged or below the full budget, COMPLETE at it, FAIL after an error."""
        known = trial_id in self._ot_trials and trial_id not in self._completed_trials
        if known and result and not error and (result["diverged"] or result["updates"] < self._max_updates):
            self._ot_trials[trial_id].report(result[self.metric], int(result["updates"]))
            result = None
        super().on_trial_complete(trial_id, result, error)
