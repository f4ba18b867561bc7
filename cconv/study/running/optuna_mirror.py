"""A copy of the trials as an Optuna study, live, in a journal file or a database that Optuna's tools can open.

No stage reads the copy; all results come from the records. Only a trial of the full budget is COMPLETE. One that ended
earlier is PRUNED and has its errors at each evaluation, so that errors of different budgets are not compared.
"""

import math
import shutil
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path

import optuna
from optuna.exceptions import StorageInternalError
from optuna.storages import BaseStorage, JournalStorage, RDBStorage
from optuna.storages.journal import JournalFileBackend
from optuna.trial import FrozenTrial, Trial, TrialState, create_trial
from sqlalchemy.exc import SQLAlchemyError

from cconv.errors import ConfigError
from cconv.study.declared.configuration import TrainingConfig
from cconv.study.declared.domains import SearchSpace
from cconv.study.records.trials import DIVERGED_ERROR, TrialRecord
from cconv.study.running.sampling import distributions_of

CONNECTION_SECONDS = 10
LOCK_FILE_SUFFIX = ".lock"


def open_storage(journal: Path, url: str | None = None) -> BaseStorage:
    """Open Optuna's storage: a journal file, or the database at `url`, e.g. ``postgresql+psycopg://user@host/studies``.

    Raises:
        ConfigError: If the database cannot be reached or its driver is not installed.
    """
    optuna.logging.set_verbosity(optuna.logging.ERROR)
    if url is None:
        return JournalStorage(JournalFileBackend(str(journal)))
    waits = {"connect_timeout": CONNECTION_SECONDS} if url.startswith("postgresql") else {}
    try:
        return RDBStorage(url, engine_kwargs={"pool_pre_ping": True, "connect_args": waits})
    except Exception as error:  # of SQLAlchemy, of the driver, or of the import of the driver
        reason = str(error).splitlines()[0]
        raise ConfigError(
            f"--storage {_without_password(url)}: no database there that Optuna can use ({reason}); "
            "start it, or leave --storage out for a journal file in the run folder."
        ) from error


def open_mirror(
    journal: Path,
    url: str | None,
    study_name: str,
    space: SearchSpace,
    full_updates: int,
    records: Sequence[TrialRecord],
) -> "OptunaMirror":
    """Open the mirror of a study in the database at `url`, or in a journal file that only this process writes.

    A journal that is damaged or lacks trials is written again from the records, and the lock of a killed process is
    removed.

    Args:
        journal: The journal file.
        url: Database to use instead, or None.
        study_name: Name of the Optuna study.
        space: Search space of all trials.
        full_updates: Full budget.
        records: Trials of the searches so far.

    Raises:
        ConfigError: If the database cannot be reached or the journal not written.
    """
    known = [record.id for record in records]
    if url is not None:
        return OptunaMirror(open_storage(journal, url), study_name, space, full_updates, known)
    try:
        for left in journal.parent.glob(f"{journal.name}{LOCK_FILE_SUFFIX}*"):
            _delete(left)
        mirror = _readable_mirror(journal, study_name, space, full_updates, known)
        if mirror is None or mirror.lacks(record.id for record in records if record.outcome != "interrupted"):
            _delete(journal)
            mirror = OptunaMirror(open_storage(journal), study_name, space, full_updates, [])
            mirror.replay(records)
    except OSError as error:
        raise ConfigError(
            f"{journal}: cannot be written ({error.strerror}); make its folder writable or give --storage URL."
        ) from error
    return mirror


def _readable_mirror(
    journal: Path, study_name: str, space: SearchSpace, full_updates: int, known: Iterable[str]
) -> "OptunaMirror | None":
    """Open the mirror in a journal; None if the journal is damaged."""
    try:
        if journal.exists() and not journal.read_bytes().endswith(b"\n"):
            return None  # Optuna would append to half a line
        return OptunaMirror(open_storage(journal), study_name, space, full_updates, known)
    except Exception:  # a damaged file can raise anything
        return None


def _delete(path: Path) -> None:
    """Delete a file, link or folder."""
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)


@contextmanager
def database_answers(url: str | None) -> Iterator[None]:
    """Turn the errors of a database that no longer answers into one clear line.

    Raises:
        ConfigError: If the database at `url` does not answer within the context.
    """
    try:
        yield
    except (StorageInternalError, SQLAlchemyError) as error:
        reason = str(error.__cause__ or error).splitlines()[0]
        raise ConfigError(
            f"--storage {_without_password(url or 'optuna.journal')}: the database no longer answers ({reason}); "
            "start it, then `cconv study resume` with the same --storage."
        ) from error


def _without_password(url: str) -> str:
    scheme, separator, rest = url.partition("://")
    login, at, place = rest.rpartition("@")
    return f"{scheme}{separator}{login.partition(':')[0]}{at}{place}"


class OptunaMirror:
    """An observer that copies the trials to an Optuna study.

    A trial that the storage has already is continued there. A running trial of the storage that has no record is marked
    as failed.

    Args:
        storage: Storage of the study.
        study_name: Name of the study.
        space: Search space of all trials, also of those from a narrowed space.
        full_updates: Full budget.
        known: Ids of the trials with a record.
    """

    def __init__(
        self, storage: BaseStorage, study_name: str, space: SearchSpace, full_updates: int, known: Iterable[str]
    ):
        self._study = optuna.create_study(
            storage=storage, study_name=study_name, direction="minimize", load_if_exists=True
        )
        self._space, self._full_updates = space, full_updates
        self._numbers: dict[str, int] = {}
        known = set(known)
        for trial in self._study.get_trials(deepcopy=False):
            name = trial.user_attrs.get("trial")
            if name in known and trial.state != TrialState.FAIL:
                self._numbers[name] = trial.number
            elif not trial.state.is_finished():
                self._study.tell(trial.number, state=TrialState.FAIL)

    def lacks(self, names: Iterable[str]) -> bool:
        """Tell whether any of the named trials is not in the storage."""
        present = {trial.user_attrs.get("trial") for trial in self._study.get_trials(deepcopy=False)}
        return not set(names) <= present

    def replay(self, records: Iterable[TrialRecord]) -> None:
        """Add trials from their records; an interrupted one stays running, because it will continue."""
        for record in records:
            self.on_trial_start(record.id, record.parameters)
            for entry in record.log:
                self.on_trial_result(record.id, entry)
            if record.outcome != "interrupted":
                self.on_trial_end(record.id, record.outcome, record.reason)

    def end_running(self) -> None:
        """Mark every trial that is still running as FAIL, so that none stays running after a run that ended early."""
        for trial in self._study.get_trials(deepcopy=False, states=[TrialState.RUNNING]):
            self._study.tell(trial.number, state=TrialState.FAIL)

    def on_data(self, findings: Sequence[str]) -> None:
        """Do nothing: Optuna has no place for findings about the data."""

    def on_stage(self, stage: str, num_trials: int, training: TrainingConfig) -> None:
        """Do nothing: all searches share the study."""

    def on_trial_start(self, trial: str, parameters: Mapping) -> None:
        """Add a running trial."""
        if trial in self._numbers:
            return
        running = create_trial(
            state=TrialState.RUNNING,
            params=dict(parameters),
            distributions=distributions_of(self._space, parameters),
            user_attrs={"trial": trial},
        )
        self._study.add_trial(running)
        self._numbers[trial] = len(self._study.get_trials(deepcopy=False)) - 1

    def on_trial_result(self, trial: str, entry: Mapping) -> None:
        """Add the error of an evaluation, or a huge one if the trial diverged, so that samplers avoid it."""
        frozen = self._frozen(trial)
        error = entry["valid_error"]
        value = DIVERGED_ERROR if entry["diverged"] or error is None else error
        if entry["updates"] not in frozen.intermediate_values and not frozen.state.is_finished():
            Trial(self._study, frozen._trial_id).report(value, entry["updates"])

    def on_trial_end(self, trial: str, outcome: str, reason: str) -> None:
        """Mark the trial as COMPLETE at the full budget, as PRUNED below it, or as FAIL if it has no error."""
        frozen = self._frozen(trial)
        if frozen.state.is_finished():
            return
        values = frozen.intermediate_values
        if outcome == "completed" and math.isfinite(values.get(self._full_updates, math.nan)):
            self._study.tell(frozen.number, values[self._full_updates])
        else:
            self._study.tell(frozen.number, state=TrialState.PRUNED if values else TrialState.FAIL)

    def _frozen(self, trial: str) -> FrozenTrial:
        return self._study.get_trials(deepcopy=False)[self._numbers[trial]]
