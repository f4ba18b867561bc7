"""Types of settings, each with a finite range, and one clear line for what does not fit: file, key, nearest name."""

import re
import typing
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated, Any, TypeVar

from pydantic import (
    AfterValidator,
    AllowInfNan,
    BaseModel,
    ConfigDict,
    Field,
    GetCoreSchemaHandler,
    PlainValidator,
    Strict,
    TypeAdapter,
    ValidationError,
)
from pydantic_core import CoreSchema, core_schema

from cconv.errors import CConvError, ConfigError, did_you_mean, shown, visible


class StrictModel(BaseModel):
    """Frozen settings; unknown keys are refused."""

    model_config = ConfigDict(extra="forbid", frozen=True)


class OpenModel(BaseModel):
    """What must stand in a record, beside anything else."""

    model_config = ConfigDict(extra="allow", frozen=True)


@dataclass(frozen=True)
class OneOf:
    """Annotates a text that must be one of some names; another is refused as by a `Literal` of these names."""

    names: tuple[str, ...]

    def __get_pydantic_core_schema__(self, source: Any, handler: GetCoreSchemaHandler) -> CoreSchema:
        return core_schema.literal_schema(list(self.names))


Flag = Annotated[bool, Strict()]
Whole = Annotated[int, Strict()]  # true is no 1
Real = Annotated[float, Strict(), AllowInfNan(False)]
Length = Annotated[Real, Field(ge=1e-12, le=1e12)]  # or another positive quantity in the units of the data
Horizon = Annotated[Whole, Field(ge=1, le=100_000)]  # frames of a rollout
Seed = Annotated[Whole, Field(ge=0, lt=2**31)]  # stages count on from it, and some libraries take 32 bits

LARGEST_VALUE, LONGEST_TEXT = 1e12, 4096
NAME_PATTERN = r"[A-Za-z][A-Za-z0-9_.-]*"


def _check_name(name: str, longest: int = 64) -> str:
    if not re.fullmatch(NAME_PATTERN, name) or len(name) > longest or ".." in name:
        raise ValueError(f"a name must match ^{NAME_PATTERN}$, have at most {longest} letters and hold no `..`")
    return name


def _check_text(text: str) -> str:
    if not all(char.isprintable() or char in "\n\t" for char in text):
        raise ValueError("a text must hold no control characters")
    return text


def _check_path(path: str) -> str:
    if not path or not path.isprintable():
        raise ValueError("a path must hold at least one character and no control characters")
    return path


def _check_inside(path: str) -> str:
    if Path(path).is_absolute() or ".." in Path(path).parts:
        raise ValueError("a path must lead to a place inside of the folder")
    return path


def _check_value(value: object) -> object:
    number = isinstance(value, int | float) and abs(value) <= LARGEST_VALUE  # no nan either
    text = isinstance(value, str) and len(value) <= 200 and value.isprintable()
    if not (number or text):
        raise ValueError(f"must be true, false, a number of at most {LARGEST_VALUE:g} or a text of up to 200 letters")
    return value


Name = Annotated[str, AfterValidator(_check_name)]  # of a study, stage or finalist: they become folders
Id = Annotated[str, AfterValidator(partial(_check_name, longest=160))]  # made of a name and what follows from it
Text = Annotated[str, Field(max_length=LONGEST_TEXT), AfterValidator(_check_text)]
PathText = Annotated[str, Field(max_length=LONGEST_TEXT), AfterValidator(_check_path)]
InnerPath = Annotated[PathText, AfterValidator(_check_inside)]  # of a record, relative to its folder
Value = Annotated[bool | int | float | str, PlainValidator(_check_value)]  # of a hyperparameter

Model = TypeVar("Model", bound=BaseModel)


def validated(model: type[Model], values: object, source: Path | str, error: type[CConvError] = ConfigError) -> Model:
    """An instance of `model` from plain values.

    Args:
        model: The pydantic model that the values must fit.
        values: What came, e.g. a parsed TOML file.
        source: File that the values came from, for the message.
        error: Kind of error to raise.

    Raises:
        CConvError: Of the kind `error`, with source, key and the first thing that is wrong.
    """
    try:
        return model.model_validate(values)
    except ValidationError as problems:
        # A misspelt key is unknown, and missing under its right name; the first says more.
        problem = min(problems.errors(), key=lambda problem: problem["type"] != "extra_forbidden")
        raise error(f"{source}: {_describe(model, values, problem)}") from problems


def check_setting(annotation: Any, value: object, name: str) -> None:
    """Raise `ConfigError` unless a value, e.g. an option of the command line, fits one of the types above."""
    try:
        TypeAdapter(annotation).validate_python(value)
    except ValidationError as problems:
        raise ConfigError(f"`{name}`: {_sentence(problems.errors()[0])}") from problems


def _describe(model: type[BaseModel], values: object, problem: Mapping) -> str:
    location = [part for part in problem["loc"] if part != "[key]"]
    written = _written_path(values, location, problem["type"] == "missing")
    key = ".".join(visible(str(part)[:80]) for part in written)
    if problem["type"] == "extra_forbidden":
        known = _known_keys(model, location[:-1])
        listed = f" Known: {', '.join(known)}." if known else ""
        return f"unknown key `{key}`.{did_you_mean(location[-1], known)}{listed}"
    if problem["type"] == "missing":
        return f"`{key}` is missing; add it."
    return f"`{key}`: {_sentence(problem)}" if key else _sentence(problem)


def _sentence(problem: Mapping) -> str:
    message = problem["msg"].removeprefix("Value error, ")
    if problem["type"] == "union_tag_invalid":  # the tag stands in the message, whole
        message = message.replace(f"'{problem['ctx']['tag']}'", shown(problem["ctx"]["tag"]))
    if problem["type"] == "union_tag_not_found":
        message = f"{problem['ctx']['discriminator']} is missing; see the documentation for what it may be"
    came = "" if isinstance(problem["input"], Mapping) else f", got {shown(problem['input'])}"
    return f"{message[0].lower()}{message[1:]}{came}."


def _written_path(values: Any, location: Sequence[str | int], is_missing: bool) -> list[str | int]:
    """The location without the names of union members, which stand in no file."""
    path = []
    for place, part in enumerate(location, start=1):
        try:
            values = _inside(values, part)
        except LookupError:
            if not (is_missing and place == len(location)):
                continue
        path.append(part)
    return path


def _inside(values: object, part: str | int) -> object:
    """What stands in a table or list at a key, a place, or a path that is written with dots.

    Raises:
        LookupError: If nothing does.
    """
    if isinstance(values, Mapping) and isinstance(part, str):
        if part in values:
            return values[part]
        name, dot, rest = part.partition(".")
        if dot:
            return _inside(values[name], rest)
    if isinstance(values, list | tuple) and isinstance(part, int):
        return values[part]
    raise KeyError(part)


def _known_keys(model: type[BaseModel], path: Iterable[str]) -> list[str]:
    candidates = [model]
    for part in path:
        inner = []
        for candidate in candidates:
            field = candidate.model_fields.get(part)
            inner.extend(_models_in(field.annotation) if field else [])
            # A union's tag or a mapping's key stands in the path too: stay at the tagged model, or at the same ones.
            if not field:
                inner.append(candidate)
        candidates = [each for each in inner if _is_tagged(each, part)] or inner
    return list(dict.fromkeys(name for candidate in candidates for name in candidate.model_fields))


def _is_tagged(model: type[BaseModel], tag: str) -> bool:
    """Whether a member of a union has this tag, as the default of one of its fields."""
    return any(isinstance(field.default, str) and field.default == tag for field in model.model_fields.values())


def _models_in(annotation: Any) -> list[type[BaseModel]]:
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return [annotation]
    return [model for argument in typing.get_args(annotation) for model in _models_in(argument)]
