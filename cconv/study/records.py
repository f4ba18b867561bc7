"""The run folder: our own records of a study. Ray's files are disposable, these are the truth."""

import json
import os
import shutil
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from cconv.errors import ConfigError, DataError

SEARCHES = ("closed_form", "initialization", "random", "adaptive")  # stages whose trials stand in trials/
# Ray and Optuna need a finite number where a trial diverged; our records hold none there.
DIVERGED_ERROR = 1e9
OUTCOMES = ("completed", "stopped", "failed", "diverged", "interrupted")


def write_json(path: Path, value) -> None:
    """Write JSON under a temporary name, then rename, so that a reader never finds half a file."""
    path.parent.mkdir(parents=True, exist_ok=True)
    part = path.with_name(f".{path.name}-{os.getpid()}")
    try:
        part.write_text(json.dumps(value, indent=2, allow_nan=False) + "\n")
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
    def last(self) -> dict | None:
        """The last evaluation with a finite error, or None."""
        finite = [entry for entry in self.log if entry["valid_normalized_mse"] is not None]
        return finite[-1] if finite else None


class TrialFolder:
    """Files of one trial: config.json, log.jsonl, outcome.json, checkpoint/."""

    def __init__(self, path: Path):
        self.path = path
        self.checkpoint = path / "checkpoint"

    @property
    def started(self) -> bool:
        """Whether the configuration has been written."""
        return (self.path / "config.json").is_file()

    def start(self, config: Mapping) -> None:
        """Begin an empty log, then write the configuration, by which a reader knows that there is a trial."""
        self.path.mkdir(parents=True, exist_ok=True)
        (self.path / "log.jsonl").write_text("")
        write_json(self.path / "config.json", config)

    def append(self, entry: Mapping) -> None:
        """Add one line to the log."""
        with (self.path / "log.jsonl").open("a") as file:
            file.write(json.dumps(entry) + "\n")

    def finish(self, outcome: str, reason: str = "") -> None:
        """Record how the trial ended."""
        write_json(self.path / "outcome.json", {"outcome": outcome, "reason": reason})

    @property
    def reason(self) -> str:
        """Why the trial failed, as far as it could say; else ""."""
        return self._end()["reason"]

    def _end(self) -> dict:
        ended = self.path / "outcome.json"
        return read_json(ended) if ended.is_file() else {"outcome": "interrupted", "reason": ""}

    def _log(self) -> list[dict]:
        path = self.path / "log.jsonl"
        lines = path.read_text().splitlines() if path.is_file() else []
        if lines and not lines[-1].endswith("}"):
            lines.pop()
        try:
            return [json.loads(line) for line in lines]
        except json.JSONDecodeError as error:
            raise DataError(f"{path}: a line is not JSON ({error}); delete that line.") from error

    def read(self) -> TrialRecord:
        """Everything that was recorded; a last log line cut short by a kill is left out."""
        config = read_json(self.path / "config.json")
        log = self._log()
        end = self._end()
        return TrialRecord(
            id=self.path.name,
            stage=config["stage"],
            parameters=config["parameters"],
            config=config,
            log=log,
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
            DataError: If it is none.
        """
        run = cls(path)
        if not (run.path / "study.json").is_file():
            raise DataError(f"{run.path}: no study.json; give the folder that `cconv study run` printed.")
        return run

    def trial(self, trial_id: str) -> TrialFolder:
        """Folder of a search trial."""
        return TrialFolder(self.path / "trials" / trial_id)

    def finalist(self, finalist_id: str, seed: int) -> TrialFolder:
        """Folder of one retraining of a finalist."""
        return TrialFolder(self.path / "finalists" / finalist_id / f"seed_{seed}")

    def trials(self) -> list[TrialRecord]:
        """Records of all search trials, stage after stage, in the order in which they were drawn."""
        records = [TrialFolder(config.parent).read() for config in (self.path / "trials").glob("*/config.json")]
        return sorted(records, key=lambda record: (SEARCHES.index(record.stage), record.id))

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
