"""The run folder: our own records of a study. Ray's files are disposable, these are the truth."""

import fcntl
import json
import math
import os
import shutil
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from cconv.errors import ConfigError, DataError

FORMAT = 2  # of a run folder; another one is refused
DIVERGED_ERROR = 1e9  # Optuna needs a finite number where a trial diverged; our records hold none there
OUTCOMES = ("completed", "stopped", "failed", "diverged", "interrupted")


def write_json(path: Path, value) -> None:
    """Write JSON under a temporary name, then rename, so that a reader never finds half a file."""
    write_text(path, json.dumps(value, indent=2, allow_nan=False) + "\n")


def write_text(path: Path, text: str) -> None:
    """Write a file under a temporary name, then rename it."""
    path.parent.mkdir(parents=True, exist_ok=True)
    part = path.with_name(f".{path.name}-{os.getpid()}")
    try:
        part.write_text(text)
        os.replace(part, path)
    finally:
        part.unlink(missing_ok=True)


def read_json(path: Path):
    """Content of a JSON file.

    Raises:
        DataError: If the file is missing or damaged.
    """
    try:
        return json.loads(path.read_text())
    except FileNotFoundError as error:
        raise DataError(f"{path}: no such file; give the folder of a study run.") from error
    except json.JSONDecodeError as error:
        raise DataError(f"{path}: not JSON ({error}); restore the file or run the study again.") from error


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
        return read_json(self.path / "config.json")["parameters"] if self.started else None

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
        lines = path.read_text(errors="replace").splitlines() if path.is_file() else []
        if lines and not lines[-1].endswith("}"):
            lines.pop()
        return [self._entry(path, number, line) for number, line in enumerate(lines, start=1)]

    @staticmethod
    def _entry(path: Path, number: int, line: str) -> dict:
        try:
            entry = json.loads(line)
            entry["updates"], entry["valid_normalized_mse"], entry["seconds"]  # noqa: B018, what every reader needs
        except (ValueError, TypeError, KeyError) as error:
            raise DataError(f"{path}: line {number} is no evaluation's record ({error}); delete that line.") from error
        return entry

    def read(self) -> TrialRecord:
        """Everything that was recorded.

        Raises:
            DataError: If a file is damaged.
        """
        config = read_json(self.path / "config.json")
        end = read_json(self.path / "outcome.json") if self.ended else {"outcome": "interrupted", "reason": ""}
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

        Raises:
            ConfigError: If the folder exists already.
        """
        run = cls(path)
        if overwrite and (run.path / "study.json").is_file():
            shutil.rmtree(run.path)
        try:
            run.path.mkdir(parents=True)
        except FileExistsError as error:
            raise ConfigError(
                f"{run.path}: exists already; give another --out, or --overwrite to replace an older run."
            ) from error
        return run

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
        written = run.read("study.json").get("format", 1)
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
            yield

    def trial(self, trial_id: str) -> TrialFolder:
        """Folder of a search trial."""
        return TrialFolder(self.path / "trials" / trial_id)

    def finalist(self, finalist_id: str, seed: int) -> TrialFolder:
        """Folder of one retraining of a finalist."""
        return TrialFolder(self.path / "finalists" / finalist_id / f"seed_{seed}")

    def trials(self) -> list[TrialRecord]:
        """Records of all search trials, stage after stage, in the order in which they were drawn."""
        stages = [*self.read("study.json")["stages"]]
        records = [TrialFolder(config.parent).read() for config in (self.path / "trials").glob("*/config.json")]
        return sorted(records, key=lambda record: (stages.index(record.stage), record.id))

    def trials_of(self, stage: str) -> list[TrialRecord]:
        """Records of one stage's trials, in the order in which they were drawn."""
        folders = sorted((self.path / "trials").glob(f"{stage}_[0-9]*/config.json"))
        records = [TrialFolder(config.parent).read() for config in folders]
        return [record for record in records if record.stage == stage]

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
        for config in sorted((self.path / "finalists").glob("*/seed_*/config.json")):
            records.setdefault(config.parent.parent.name, []).append(TrialFolder(config.parent).read())
        return records

    def write(self, name: str, value) -> None:
        """Write a JSON file of the run folder."""
        write_json(self.path / name, value)

    def read(self, name: str):
        """Read a JSON file of the run folder."""
        return read_json(self.path / name)

    def set_state(self, state: str, stage: str) -> None:
        """Record whether the run is "running", "finished", "interrupted" or "failed", and in which stage."""
        self.write("state.json", {"state": state, "stage": stage})


def count_outcomes(records: Sequence[TrialRecord]) -> dict[str, dict[str, int]]:
    """Number of trials of each outcome, by stage."""
    stages = list(dict.fromkeys(record.stage for record in records))
    counts = {stage: Counter(record.outcome for record in records if record.stage == stage) for stage in stages}
    return {stage: {outcome: counts[stage][outcome] for outcome in OUTCOMES} for stage in stages}
