"""The run folder with the records of a study. All facts are read from these records, never from Ray's own files."""

import re
import shutil
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

from filelock import Timeout

from cconv.errors import ConfigError, DataError, shown
from cconv.files import held, write_json
from cconv.study.records.forms import FORMS, Table, read_record, read_typed
from cconv.study.records.found import Found, StageResult
from cconv.study.records.summary import Summary
from cconv.study.records.trials import KNOWN_BEFORE, TrialFolder, TrialRecord
from cconv.validation import Id, check_setting

FORMAT = 4  # version of the layout of run folders; other versions are refused

_PART = re.compile(r"\..+-\d+(\.\w+)?")  # temporary names; a kill leaves such files behind
_FIRST_FILES = {"space.json", "state.json"}  # written before study.json


class RunFolder:
    """A study's folder ``runs/<study>/``; the README says what it holds."""

    def __init__(self, path: Path | str):
        self.path = Path(path)

    @classmethod
    def create(cls, path: Path | str, overwrite: bool = False) -> "RunFolder":
        """Create a run folder; with `overwrite` it replaces an older run, but never another folder.

        A folder whose run was killed before study.json was written may be replaced too.

        Raises:
            ConfigError: If the folder exists already.
        """
        run = cls(path)
        if run.path.is_dir() and (run._is_barely_begun() or (overwrite and (run.path / "study.json").is_file())):
            shutil.rmtree(run.path)
        try:
            run.path.mkdir(parents=True)
        except FileExistsError as error:
            raise ConfigError(
                f"{run.path}: exists already; give another --out, or --overwrite to replace an older run."
            ) from error
        return run

    def _is_barely_begun(self) -> bool:
        names = {path.name for path in self.path.iterdir()}
        return bool(names) and all(name in _FIRST_FILES or _PART.fullmatch(name) for name in names)

    def remove_half_written(self) -> None:
        """Delete the unfinished files of a killed process; call this only while holding the lock of the folder."""
        for path in [path for path in self.path.rglob(".*") if _PART.fullmatch(path.name)]:
            if path.is_dir() and not path.is_symlink():
                shutil.rmtree(path, ignore_errors=True)
            else:
                path.unlink(missing_ok=True)

    def remove(self) -> None:
        """Delete the folder and everything in it."""
        shutil.rmtree(self.path)

    @classmethod
    def open(cls, path: Path | str) -> "RunFolder":
        """Open an existing run folder.

        Raises:
            DataError: If the folder is no run folder or has another version.
        """
        run = cls(path)
        if not (run.path / "study.json").is_file():
            raise DataError(f"{run.path}: no study.json; give the folder that `cconv study run` printed.")
        written = read_record(run.path / "study.json").get("format", 1)
        if written != FORMAT:
            raise DataError(
                f"{run.path}: a run folder of format {shown(written)}, and this version of cconv reads format "
                f"{FORMAT}; run the study again, or open it with the version in its environment.json."
            )
        return run

    @contextmanager
    def locked(self) -> Iterator[None]:
        """Lock the folder for this process; the system releases the lock even if the process is killed.

        Raises:
            ConfigError: If another run works in the folder.
        """
        lock = self.path / "run.lock"
        with ExitStack() as stack:
            try:
                stack.enter_context(held(lock))
            except Timeout as error:
                raise ConfigError(
                    f"{self.path}: another run works in this folder; wait for it (`cconv study status`) or stop it."
                ) from error
            except OSError as error:
                way_out = "make it writable" if isinstance(error, PermissionError) else "use a file system with locks"
                raise ConfigError(f"{lock}: cannot be locked ({error.strerror or error}); {way_out}.") from error
            yield

    def trial(self, trial_id: str) -> TrialFolder:
        """Return the folder of a search trial."""
        return TrialFolder(self.path / "trials" / checked_id(trial_id))

    def finalist(self, finalist_id: str, seed: int) -> TrialFolder:
        """Return the folder of one retraining of a finalist."""
        return TrialFolder(self.path / "finalists" / checked_id(finalist_id) / f"seed_{seed:d}")

    def trials(self) -> list[TrialRecord]:
        """Read the records of all search trials, stage after stage, in the order in which they were drawn."""
        return [record for stage in self.read("study.json")["stages"] for record in self.trials_of(stage)]

    def trials_of(self, stage: str) -> list[TrialRecord]:
        """Read the records of the trials of one stage, in the order in which they were drawn.

        Raises:
            DataError: If a record is damaged or belongs to another stage.
        """
        name = re.compile(rf"{re.escape(stage)}_(\d{{4,}})")
        matches = [name.fullmatch(folder.name) for folder in _folders(self.path / "trials")]
        numbered = sorted((int(match[1]), match[0]) for match in matches if match)
        folders = [self.trial(trial) for _, trial in numbered]
        records = [folder.read() for folder in folders if folder.started]
        for record in records:
            self._check_trial(record, stage)
        return records

    def _check_trial(self, record: TrialRecord, stage: str) -> None:
        path = self.trial(record.id).path / "config.json"
        if record.stage != stage:
            raise DataError(f"{path}: `stage` must be {stage!r}, got {shown(record.stage)}; restore the file.")
        for name in KNOWN_BEFORE:  # None if the trial failed before it began
            if record.log and record.config[name] is None:
                raise DataError(f"{path}: `{name}` is missing, though the trial was evaluated; restore the file.")

    def has_result(self, stage: str) -> bool:
        """Tell whether a stage has finished."""
        return self._result(stage).is_file()

    def result(self, stage: str) -> StageResult:
        """Read the result of a finished stage.

        Raises:
            DataError: If its file is missing or damaged, or a key or value does not fit.
        """
        return read_typed(self._result(stage), StageResult)

    def write_result(self, stage: str, kind: str, seconds: float, found: Found) -> None:
        """Write the result of a stage; its file marks the stage as finished."""
        result = {"kind": kind, "seconds": seconds} | found.model_dump(mode="json", exclude_unset=True)
        write_json(self._result(stage), result)

    def forget_result(self, stage: str) -> None:
        """Mark a stage as unfinished; its trials stay."""
        self._result(stage).unlink(missing_ok=True)

    def _result(self, stage: str) -> Path:
        return self.path / "stages" / f"{stage}.json"

    @property
    def has_summary(self) -> bool:
        """True if the study has recommended a model."""
        return self._summary.is_file()

    def summary(self) -> Summary:
        """Read the summary of a finished study.

        Raises:
            DataError: If its file is missing or damaged, or a key or value does not fit.
        """
        return read_typed(self._summary, Summary)

    def write_summary(self, summary: Summary) -> None:
        """Write ``summary.json``."""
        write_json(self._summary, summary.model_dump(mode="json", exclude_unset=True))

    @property
    def _summary(self) -> Path:
        return self.path / "summary.json"

    def retrainings(self) -> dict[str, list[TrialRecord]]:
        """Read the records of all retrainings, by finalist."""
        records: dict[str, list[TrialRecord]] = {}
        for finalist in _folders(self.path / "finalists"):
            seeds = [TrialFolder(folder) for folder in _folders(finalist) if re.fullmatch(r"seed_\d+", folder.name)]
            read = [folder.read() for folder in seeds if folder.started]
            for record in read:
                if record.config["init_seed"] not in (None, int(record.id.removeprefix("seed_"))):
                    raise DataError(f"{finalist / record.id}/config.json: `init_seed` is not that of the folder.")
            if read:
                records[checked_id(finalist.name)] = read
        return records

    def write(self, name: str, value: object) -> None:
        """Write a JSON file of the run folder."""
        write_json(self.path / name, value)

    def read(self, name: str) -> dict[str, Any]:
        """Read a JSON file of the run folder.

        Raises:
            DataError: If it is missing or damaged, or a key or value does not fit.
        """
        return read_record(self.path / name, FORMS.get(name, Table))

    def set_state(self, state: str, stage: str) -> None:
        """Record whether the run is "running", "finished", "interrupted" or "failed", and in which stage."""
        self.write("state.json", {"state": state, "stage": stage})


def checked_id(name: str) -> str:
    """Return the id of a trial or finalist, after a check that it is a safe name of a folder.

    Raises:
        ConfigError: If the id could lead out of the run folder.
    """
    check_setting(Id, name, "the id of a training")
    return name


def _folders(path: Path) -> list[Path]:
    return sorted(folder for folder in path.iterdir() if folder.is_dir()) if path.is_dir() else []
