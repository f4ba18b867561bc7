"""Our trial records as an Optuna study, in a journal file that Optuna's tools open."""

from collections.abc import Sequence
from pathlib import Path

import optuna
from optuna.storages import BaseStorage, JournalStorage
from optuna.storages.journal import JournalFileBackend
from optuna.trial import FrozenTrial, TrialState, create_trial

from cconv.study.records import DIVERGED_ERROR, TrialRecord
from cconv.study.space import SearchSpace, optuna_distributions


def open_journal(path: Path) -> BaseStorage:
    """Optuna storage in a journal file; new trials append to it."""
    optuna.logging.set_verbosity(optuna.logging.WARNING)
    return JournalStorage(JournalFileBackend(str(path)))


def mirror_trials(
    records: Sequence[TrialRecord], space: SearchSpace, max_updates: int, storage: BaseStorage, study_name: str
) -> None:
    """Add finished trials to an Optuna study.

    Only a trial of the full budget is COMPLETE; one stopped earlier is PRUNED with its errors at each evaluation, so
    that errors of different budgets are never compared as equals. A diverged trial is PRUNED with a huge last error, so
    that the sampler keeps away from it; a trial without any error is FAIL.
    """
    study = optuna.create_study(storage=storage, study_name=study_name, direction="minimize", load_if_exists=True)
    for record in records:
        study.add_trial(_as_optuna(record, space, max_updates))


def _as_optuna(record: TrialRecord, space: SearchSpace, max_updates: int) -> FrozenTrial:
    values = {
        entry["updates"]: entry["valid_normalized_mse"]
        for entry in record.log
        if entry["valid_normalized_mse"] is not None
    }
    if record.outcome == "diverged" and record.log:
        values[record.log[-1]["updates"]] = DIVERGED_ERROR
    complete = record.outcome == "completed" and max_updates in values
    state = TrialState.COMPLETE if complete else TrialState.PRUNED if values else TrialState.FAIL
    return create_trial(
        state=state,
        value=values[max_updates] if complete else None,
        params=record.parameters,
        distributions=optuna_distributions(space),
        intermediate_values=values,
        user_attrs={"trial": record.id, "num_parameters": record.config["num_parameters"]},
    )
