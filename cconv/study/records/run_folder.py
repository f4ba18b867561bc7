"""The run folder: our own records of a study. Ray's files are disposable, these are the truth."""

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

FORMAT = 4  # of a run folder; another one is refused

_PART = re.compile(r"\..+-\d+(\.\w+)?")  # names of what is being written, which a kill leaves behind
_FIRST_FILES = {"space.json", "state.json"}  # of a run folder, written before study.json


class RunFolder:
    """A study's folder ``runs/<study>/``; the README says what it holds."""

    def __init__(self, path: Path | str):
        self.path = Path(path)

    @classmethod
    def create(cls, path: Path | str, overwrite: bool = False) -> "RunFolder":
        """A new run folder; with `overwrite` it replaces an older run, never anything else.

        A folder whose run was killed before study.json was written counts as new.

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
        """Delete what a killed process was writing; only who holds the folder may."""
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
        """An existing run folder.

        Raises:
            DataError: If it is none, or one of another version.
        """
        run = cls(path)
        if not (run.path / "study.json").is_file():
            raise DataError(f"{run.path}: no study.json; give the folder that `cconv study run` printed.")
        written = read_record(run.path / "study.json").get("format", 1)
        if written != FORMAT:
            raise DataError(
                f"{run.path}: a run folder of format {written}, and this version of cconv reads format {FORMAT}; "
                "run the study again, or open it with the version in its environment.json."
            )
        return run

    @contextmanager
    def locked(self) -> Iterator[None]:
        """Hold the folder alone; the system lets go of it even if the process is killed.

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
        """Folder of a search trial."""
        return TrialFolder(self.path / "trials" / checked_id(trial_id))

    def finalist(self, finalist_id: str, seed: int) -> TrialFolder:
        """Folder of one retraining of a finalist."""
        return TrialFolder(self.path / "finalists" / checked_id(finalist_id) / f"seed_{seed:d}")

    def trials(self) -> list[TrialRecord]:
        """Records of all search trials, stage after stage, in the order in which they were drawn."""
        return [record for stage in self.read("study.json")["stages"] for record in self.trials_of(stage)]

    def trials_of(self, stage: str) -> list[TrialRecord]:
        """Records of one stage's trials, in the order in which they were drawn.

        Raises:
            DataError: If a record is damaged, or that of a trial of another stage.
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
        for name in KNOWN_BEFORE:  # None where it failed before it began
            if record.log and record.config[name] is None:
                raise DataError(f"{path}: `{name}` is missing, though the trial was evaluated; restore the file.")

    def has_result(self, stage: str) -> bool:
        """Whether a stage has come to its end."""
        return self._result(stage).is_file()

    def result(self, stage: str) -> StageResult:
        """What a stage that ended has found.

        Raises:
            DataError: If its file is missing or damaged, or a key or value does not fit.
        """
        return read_typed(self._result(stage), StageResult)

    def write_result(self, stage: str, kind: str, seconds: float, found: Found) -> None:
        """Record what a stage has found, by which a reader knows that it has ended."""
        result = {"kind": kind, "seconds": seconds} | found.model_dump(mode="json", exclude_unset=True)
        write_json(self._result(stage), result)

    def forget_result(self, stage: str) -> None:
        """Make a stage one that has not come to its end; its trials stay."""
        self._result(stage).unlink(missing_ok=True)

    def _result(self, stage: str) -> Path:
        return self.path / "stages" / f"{stage}.json"

    @property
    def has_summary(self) -> bool:
        """Whether the study has recommended a model."""
        return self._summary.is_file()

    def summary(self) -> Summary:
        """What a study that recommended a model has found.

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
        """Records of all retrainings, by finalist."""
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
    """The id of a trial or finalist, which becomes a folder.

    Raises:
        ConfigError: If it could lead out of the folder of all of them.
    """
    check_setting(Id, name, "the id of a training")
    return name


def _folders(path: Path) -> list[Path]:
    return sorted(folder for folder in path.iterdir() if folder.is_dir()) if path.is_dir() else []
