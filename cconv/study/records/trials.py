"""The record of one training on disk: configuration, log, outcome and checkpoint."""

import json
import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from cconv.errors import ConfigError, DataError
from cconv.files import parse_json, read_text, write_json, write_text
from cconv.study.records.forms import OUTCOMES, Entry, Outcome, TrainingDescription, read_record
from cconv.validation import validated

DIVERGED_ERROR = 1e9  # Optuna needs a finite error of a diverged trial; our records hold None


KNOWN_BEFORE = ("init_seed", "num_parameters", "flops_per_particle")  # a training begins


@dataclass(frozen=True, kw_only=True)
class TrialRecord:
    """The record of one training.

    Attributes:
        id: Name of its folder.
        stage: Name of the stage that it belongs to, or "train" for `cconv train`.
        parameters: Hyperparameters that were drawn.
        config: Resolved network and training settings, seeds, number of parameters.
        log: One entry for each evaluation: updates, train_loss, valid_error, learning_rate, seconds, diverged.
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
        """True if the model was fitted by least squares, without a seed."""
        return self.config.get("closed_form", False)

    @property
    def best(self) -> float:
        """Smallest validation error of the log, the error of the checkpoint; infinity if there is none."""
        finite = (entry["valid_error"] for entry in self.log)
        return min((error for error in finite if error is not None), default=math.inf)

    def error_at(self, updates: int) -> float | None:
        """Return the validation error after a number of updates; None if it was not measured or is not finite."""
        return next((entry["valid_error"] for entry in self.log if entry["updates"] == updates), None)

    @property
    def last(self) -> dict | None:
        """The last evaluation with a finite error, or None."""
        finite = [entry for entry in self.log if entry["valid_error"] is not None]
        return finite[-1] if finite else None

    @property
    def last_error(self) -> float | None:
        """Validation error of the last evaluation with a finite one, or None."""
        return self.last["valid_error"] if self.last else None

    @property
    def final_error(self) -> float | None:
        """The last validation error of a training of the full budget; None for any other."""
        return self.last_error if self.outcome == "completed" else None


class TrialFolder:
    """Files of one trial: config.json, log.jsonl, outcome.json, checkpoint/, and its progress while it runs."""

    def __init__(self, path: Path):
        self.path = path
        self.checkpoint = path / "checkpoint"
        self.progress = path / "progress.safetensors"

    @property
    def started(self) -> bool:
        """True if the configuration has been written."""
        return (self.path / "config.json").is_file()

    @property
    def parameters(self) -> dict | None:
        """Hyperparameters of the configuration; None before it has been written."""
        return read_record(self.path / "config.json", TrainingDescription)["parameters"] if self.started else None

    def check_begun_with(self, parameters: Mapping) -> None:
        """Raise `ConfigError` if the trial was begun with other hyperparameters."""
        if self.parameters not in (None, dict(parameters)):
            raise ConfigError(
                f"{self.path}: was begun with other hyperparameters than the study now gives it, as study.json, "
                "space.json or earlier records were changed; undo that, or delete this folder, or run the study into "
                "another one."
            )

    def start(self, config: Mapping) -> None:
        """Begin an empty log, then write the configuration; its file marks the trial as started."""
        self.path.mkdir(parents=True, exist_ok=True)
        (self.path / "log.jsonl").write_text("")
        write_json(self.path / "config.json", config)

    def go_on(self, updates: int) -> None:
        """Drop the entries of the log after `updates`, where the training continues."""
        kept = [entry for entry in self.log() if entry["updates"] <= updates]
        write_text(self.path / "log.jsonl", "".join(json.dumps(entry) + "\n" for entry in kept))

    def append(self, entry: Mapping) -> None:
        """Add one line to the log."""
        with (self.path / "log.jsonl").open("a") as file:
            file.write(json.dumps(entry) + "\n")

    def finish(self, outcome: str, reason: str = "") -> None:
        """Record the outcome of the trial, which is final."""
        self.progress.unlink(missing_ok=True)
        write_json(self.path / "outcome.json", {"outcome": outcome, "reason": reason})

    @property
    def ended(self) -> bool:
        """True if the outcome of the trial is recorded."""
        return (self.path / "outcome.json").is_file()

    def log(self) -> list[dict]:
        """Read the evaluations so far, without a last line that a kill cut short."""
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
        validated(Entry, entry, f"{path}: line {number} is no evaluation's record; delete that line", DataError)
        return entry

    def read(self) -> TrialRecord:
        """Read the whole record.

        Raises:
            DataError: If a file is damaged.
        """
        config: dict[str, Any] = dict.fromkeys(KNOWN_BEFORE)
        config |= read_record(self.path / "config.json", TrainingDescription)
        end = {"outcome": "interrupted", "reason": ""}
        if self.ended:
            end = read_record(self.path / "outcome.json", Outcome)
        return TrialRecord(
            id=self.path.name,
            stage=config["stage"],
            parameters=config["parameters"],
            config=config,
            log=self.log(),
            outcome=end["outcome"],
            reason=end["reason"],
        )


def identity(parameters: Mapping) -> str:
    """Return a key that two configurations share only if their hyperparameters are the same."""
    return repr(sorted(parameters.items()))


def count_outcomes(records: Sequence[TrialRecord]) -> dict[str, dict[str, int]]:
    """Count the trials of each outcome, by stage."""
    stages = list(dict.fromkeys(record.stage for record in records))
    counts = {stage: Counter(record.outcome for record in records if record.stage == stage) for stage in stages}
    return {stage: {outcome: counts[stage][outcome] for outcome in OUTCOMES} for stage in stages}
