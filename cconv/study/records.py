"""The run folder: our own records of a study. Ray's files are disposable, these are the truth."""

import fcntl
import json
import math
import os
import re
import shutil
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from pydantic import BaseModel, Field, RootModel

from cconv.errors import ConfigError, DataError, shown
from cconv.files import parse_json, read_json, read_text
from cconv.validation import Flag, Id, Name, OpenModel, Real, Value, Whole, check_setting, validated

FORMAT = 2  # of a run folder; another one is refused
DIVERGED_ERROR = 1e9  # Optuna needs a finite number where a trial diverged; our records hold none there
OUTCOMES = ("completed", "stopped", "failed", "diverged", "interrupted")
KNOWN_BEFORE = ("init_seed", "num_parameters", "flops_per_particle")  # a training begins

_PART = re.compile(r"\..+-\d+")  # names of what is being written, which a kill leaves behind
_FIRST_FILES = {"space.json", "state.json"}  # of a run folder, written before study.json

_Count = Annotated[Whole, Field(ge=0, lt=2**63)]
_Error = Annotated[Real, Field(ge=0)]


def write_json(path: Path, value) -> None:
    """Write JSON under a temporary name, then rename, so that a reader never finds half a file."""
    write_text(path, json.dumps(value, indent=2, allow_nan=False) + "\n")


def write_text(path: Path, text: str) -> None:
    """Write a file under a temporary name, then rename it."""
    path.parent.mkdir(parents=True, exist_ok=True)
    part = path.with_name(f".{path.name}-{os.getpid()}")  # `_PART` matches it
    try:
        part.write_text(text)
        os.replace(part, path)
    finally:
        part.unlink(missing_ok=True)


class _Entry(OpenModel):
    """A line of log.jsonl."""

    updates: _Count
    valid_normalized_mse: _Error | None
    seconds: _Error
    train_loss: _Error | None = None
    learning_rate: Real | None = None
    diverged: Flag = False


class _Config(OpenModel):
    """config.json of a training; what costs nothing was known before it began, the rest is None where it failed."""

    stage: Name
    parameters: dict[str, Value]
    init_seed: Annotated[Whole, Field(ge=0, lt=2**32)] | None = None
    num_parameters: _Count | None = None
    flops_per_particle: _Error | None = None
    closed_form: Flag = False


class _Outcome(OpenModel):
    """outcome.json of a training."""

    outcome: Literal[OUTCOMES]
    reason: str


class _StageSettings(OpenModel):
    """A stage in study.json."""

    kind: str


class _Study(OpenModel):
    """study.json, as far as a reader of records needs it."""

    format: _Count = 1
    id: Annotated[str, Field(pattern=r"^[0-9a-f]{1,64}$")] = "0"
    name: Name = "study"
    stages: Annotated[dict[Name, _StageSettings], Field(min_length=1, max_length=100)]


class _State(OpenModel):
    """state.json."""

    state: Literal["running", "finished", "interrupted", "failed"]
    stage: Name


class _Rung(OpenModel):
    """A rung of a stage in rungs.json."""

    updates: _Count
    recorded: dict[str, _Error]


class _Rungs(RootModel):
    """rungs.json."""

    root: dict[Name, list[_Rung]]


class _Line(OpenModel):
    """Something that does not make sense in the data."""

    line: str


class _Seeds(OpenModel):
    """Seeds in environment.json."""

    data: Whole
    init: Whole
    search: Whole


class _DataFolder(OpenModel):
    """Data in environment.json."""

    sha256: str


class _Environment(OpenModel):
    """environment.json, as far as the report needs it."""

    started: str
    packages: dict[str, str | None]
    seeds: _Seeds
    data: _DataFolder
    data_findings: list[_Line] = []


class _Table(RootModel):
    """Any other file."""

    root: dict


class _Result(OpenModel):
    """What a stage has found, in stages/."""

    kind: str
    seconds: _Error
    finalists: dict[Id, dict[str, Value]] = {}


class _Model(OpenModel):
    """The recommended model in summary.json."""

    id: Id
    reason: str


class _Finalist(OpenModel):
    """A finalist in summary.json."""

    id: Id
    num_parameters: _Count
    config: dict
    test: dict
    cost: dict
    stability: dict | None


class _Importance(OpenModel):
    """Importance at a rung in summary.json."""

    updates: _Count
    trials: _Count
    why_none: str
    parameters: dict[str, dict]


class _Summary(OpenModel):
    """summary.json, as far as every reader needs it."""

    study: Name
    baseline: Name
    recommended: _Model
    finalists: Annotated[list[_Finalist], Field(min_length=1)]
    pareto_front: list[Id]
    wall_seconds: _Error
    importance: list[_Importance] = []


_FORMS = {
    "study.json": _Study,
    "environment.json": _Environment,
    "state.json": _State,
    "rungs.json": _Rungs,
    "summary.json": _Summary,
}


def read_record(path: Path, form: type[BaseModel] = _Table):
    """Content of a JSON file that fits a form.

    Raises:
        DataError: If the file is missing or damaged, or a key or value does not fit.
    """
    content = read_json(path)
    validated(form, content, path, DataError)
    return content


def read_rungs(path: Path) -> dict[str, list[dict]]:
    """Rungs of every stage that has any, from rungs.json."""
    return read_record(path, _Rungs) if path.exists() else {}


@dataclass(frozen=True, kw_only=True)
class TrialRecord:
    """What is known of one training.

    Attributes:
        id: Name of its folder.
        stage: "closed_form", "initialization", "random", "adaptive", "finalists" or "train".
        parameters: Hyperparameters that were drawn.
        config: Resolved network and training settings, seeds, number of parameters.
        log: One entry an evaluation: updates, train_loss, valid_normalized_mse, learning_rate, seconds, diverged.
        outcome: One of `OUTCOMES`; "interrupted" if the run ended before the trial did.
        reason: Why it failed, or "".
    """

    id: str
    stage: str
    parameters: dict
    config: dict
    log: list[dict]
    outcome: str
    reason: str

    @property
    def is_closed_form(self) -> bool:
        """Whether least squares found it, so that no seed was drawn."""
        return self.config.get("closed_form", False)

    @property
    def best(self) -> float:
        """Smallest validation error of the log, that of the checkpoint; infinity where there is none."""
        finite = (entry["valid_normalized_mse"] for entry in self.log)
        return min((error for error in finite if error is not None), default=math.inf)

    def error_at(self, updates: int) -> float | None:
        """Validation error after a number of updates; None if it was not measured there or not finite."""
        return next((entry["valid_normalized_mse"] for entry in self.log if entry["updates"] == updates), None)

    @property
    def last(self) -> dict | None:
        """The last evaluation with a finite error, or None."""
        finite = [entry for entry in self.log if entry["valid_normalized_mse"] is not None]
        return finite[-1] if finite else None


class TrialFolder:
    """Files of one trial: config.json, log.jsonl, outcome.json, checkpoint/, and its progress while it runs."""

    def __init__(self, path: Path):
        self.path = path
        self.checkpoint = path / "checkpoint"
        self.progress = path / "progress.safetensors"

    @property
    def started(self) -> bool:
        """Whether the configuration has been written."""
        return (self.path / "config.json").is_file()

    @property
    def parameters(self) -> dict | None:
        """Hyperparameters of the configuration; None before it has been written."""
        return read_record(self.path / "config.json", _Config)["parameters"] if self.started else None

    def check_begun_with(self, parameters: Mapping) -> None:
        """Raise `ConfigError` if the trial was begun with other hyperparameters."""
        if self.parameters not in (None, dict(parameters)):
            raise ConfigError(
                f"{self.path}: was begun with other hyperparameters than the study now gives it, as study.json, "
                "space.json or earlier records were changed; undo that, or delete this folder, or run the study into "
                "another one."
            )

    def start(self, config: Mapping) -> None:
        """Begin an empty log, then write the configuration, by which a reader knows that there is a trial."""
        self.path.mkdir(parents=True, exist_ok=True)
        (self.path / "log.jsonl").write_text("")
        write_json(self.path / "config.json", config)

    def go_on(self, updates: int) -> None:
        """Drop what was logged after `updates`, from where the training goes on."""
        kept = [entry for entry in self.log() if entry["updates"] <= updates]
        write_text(self.path / "log.jsonl", "".join(json.dumps(entry) + "\n" for entry in kept))

    def append(self, entry: Mapping) -> None:
        """Add one line to the log."""
        with (self.path / "log.jsonl").open("a") as file:
            file.write(json.dumps(entry) + "\n")

    def finish(self, outcome: str, reason: str = "") -> None:
        """Record how the trial ended; it does not go on from there."""
        self.progress.unlink(missing_ok=True)
        write_json(self.path / "outcome.json", {"outcome": outcome, "reason": reason})

    @property
    def ended(self) -> bool:
        """Whether it is known how the trial ended."""
        return (self.path / "outcome.json").is_file()

    def log(self) -> list[dict]:
        """Evaluations so far; a last line cut short by a kill is left out."""
        path = self.path / "log.jsonl"
        lines = read_text(path).splitlines() if path.exists() else []
        if lines and not lines[-1].endswith("}"):
            lines.pop()
        return [self._entry(path, number, line) for number, line in enumerate(lines, start=1)]

    @staticmethod
    def _entry(path: Path, number: int, line: str) -> dict:
        try:
            entry = parse_json(line)
        except ValueError as error:
            raise DataError(f"{path}: line {number} is no evaluation's record ({error}); delete that line.") from error
        validated(_Entry, entry, f"{path}: line {number} is no evaluation's record; delete that line", DataError)
        return entry

    def read(self) -> TrialRecord:
        """Everything that was recorded.

        Raises:
            DataError: If a file is damaged.
        """
        config = dict.fromkeys(KNOWN_BEFORE) | read_record(self.path / "config.json", _Config)
        end = {"outcome": "interrupted", "reason": ""}
        if self.ended:
            end = read_record(self.path / "outcome.json", _Outcome)
        return TrialRecord(
            id=self.path.name,
            stage=config["stage"],
            parameters=config["parameters"],
            config=config,
            log=self.log(),
            outcome=end["outcome"],
            reason=end["reason"],
        )


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
        with (self.path / "run.lock").open("w") as file:
            try:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError as error:
                raise ConfigError(
                    f"{self.path}: another run works in this folder; wait for it (`cconv study status`) or stop it."
                ) from error
            except OSError as error:
                raise ConfigError(
                    f"{file.name}: cannot be locked ({error.strerror}); put the run folder on a file system with locks."
                ) from error
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
        return (self.path / "stages" / f"{stage}.json").is_file()

    def result(self, stage: str) -> dict:
        """What a stage that ended has found."""
        return self.read(f"stages/{stage}.json")

    def forget_result(self, stage: str) -> None:
        """Make a stage one that has not come to its end; its trials stay."""
        (self.path / "stages" / f"{stage}.json").unlink(missing_ok=True)

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

    def write(self, name: str, value) -> None:
        """Write a JSON file of the run folder."""
        write_json(self.path / name, value)

    def read(self, name: str):
        """Read a JSON file of the run folder.

        Raises:
            DataError: If it is missing or damaged, or a key or value does not fit.
        """
        return read_record(self.path / name, _Result if name.startswith("stages/") else _FORMS.get(name, _Table))

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


def count_outcomes(records: Sequence[TrialRecord]) -> dict[str, dict[str, int]]:
    """Number of trials of each outcome, by stage."""
    stages = list(dict.fromkeys(record.stage for record in records))
    counts = {stage: Counter(record.outcome for record in records if record.stage == stage) for stage in stages}
    return {stage: {outcome: counts[stage][outcome] for outcome in OUTCOMES} for stage in stages}
