"""The forms of the JSON files of a run folder; a file that does not fit its form is an error of one line."""

from pathlib import Path
from typing import Annotated, Any, Literal, get_args

from pydantic import BaseModel, Field, RootModel

from cconv.errors import DataError
from cconv.files import read_json
from cconv.validation import Flag, Model, Name, OpenModel, Real, Value, Whole, validated

OutcomeName = Literal["completed", "stopped", "failed", "diverged", "interrupted"]
OUTCOMES: tuple[str, ...] = get_args(OutcomeName)

Count = Annotated[Whole, Field(ge=0, lt=2**63)]
NonNegative = Annotated[Real, Field(ge=0)]


class Entry(OpenModel):
    """A line of log.jsonl."""

    updates: Count
    valid_error: NonNegative | None
    seconds: NonNegative
    cpu_seconds: NonNegative | None = None
    train_loss: NonNegative | None = None
    learning_rate: Real | None = None
    diverged: Flag = False


class TrainingDescription(OpenModel):
    """config.json of a training; values that are None belong to a training that failed before it began."""

    stage: Name
    parameters: dict[str, Value]
    init_seed: Annotated[Whole, Field(ge=0, lt=2**32)] | None = None
    num_parameters: Count | None = None
    flops_per_particle: NonNegative | None = None
    closed_form: Flag = False


class Outcome(OpenModel):
    """outcome.json of a training."""

    outcome: OutcomeName
    reason: str


class _StageSettings(OpenModel):
    """A stage in study.json."""

    kind: str


class _Study(OpenModel):
    """The part of study.json that readers of records need."""

    format: Count = 1
    id: Annotated[str, Field(pattern=r"^[0-9a-f]{1,64}$")] = "0"
    name: Name = "study"
    stages: Annotated[dict[Name, _StageSettings], Field(min_length=1, max_length=100)]


class _State(OpenModel):
    """state.json."""

    state: Literal["running", "finished", "interrupted", "failed"]
    stage: Name


class _Rung(OpenModel):
    """A rung of a stage in rungs.json."""

    updates: Count
    recorded: dict[str, NonNegative]


class Rungs(RootModel):
    """rungs.json."""

    root: dict[Name, list[_Rung]]


class _Line(OpenModel):
    """An implausibility of the data."""

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
    """The part of environment.json that the report needs."""

    started: str
    packages: dict[str, str | None]
    seeds: _Seeds
    data: _DataFolder
    data_findings: list[_Line]


class Table(RootModel):
    """Any other file."""

    root: dict


FORMS: dict[str, type[BaseModel]] = {
    "study.json": _Study,
    "environment.json": _Environment,
    "state.json": _State,
    "rungs.json": Rungs,
}


def read_typed(path: Path, form: type[Model]) -> Model:
    """Read a JSON file as an instance of its form.

    Raises:
        DataError: If the file is missing or damaged, or a key or value does not fit.
    """
    return validated(form, read_json(path), path, DataError)


def read_record(path: Path, form: type[BaseModel] = Table) -> dict[str, Any]:
    """Read a JSON file, check it against a form, and return its content unchanged.

    Raises:
        DataError: If the file is missing or damaged, or a key or value does not fit.
    """
    content = read_json(path)
    validated(form, content, path, DataError)
    return content


def read_rungs(path: Path) -> dict[str, list[dict]]:
    """Read the rungs of every stage that has any from rungs.json."""
    return read_record(path, Rungs) if path.exists() else {}
