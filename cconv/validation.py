"""One clear line for a file that does not fit its pydantic model: file, key, what is wrong, nearest name."""

import typing
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import TypeVar

from pydantic import BaseModel, ConfigDict, ValidationError

from cconv.errors import ConfigError, did_you_mean


class StrictModel(BaseModel):
    """Frozen settings; unknown keys are refused."""

    model_config = ConfigDict(extra="forbid", frozen=True)


Value = bool | int | float | str  # of a hyperparameter

Model = TypeVar("Model", bound=BaseModel)


def validated(model: type[Model], values: Mapping, source: Path | str) -> Model:
    """An instance of `model` from plain values.

    Args:
        model: The pydantic model that the values must fit.
        values: What came, e.g. a parsed TOML file.
        source: File that the values came from, for the message.

    Raises:
        ConfigError: With source, key and the first thing that is wrong.
    """
    try:
        return model.model_validate(values)
    except ValidationError as error:
        # A misspelt key is unknown, and missing under its right name; the first says more.
        problem = min(error.errors(), key=lambda problem: problem["type"] != "extra_forbidden")
        raise ConfigError(f"{source}: {_describe(model, values, problem)}") from error


def _describe(model: type[BaseModel], values: Mapping, problem: Mapping) -> str:
    location = [str(part) for part in problem["loc"]]
    key = ".".join(_written_path(values, location)) or "the file"
    if problem["type"] == "extra_forbidden":
        known = _known_keys(model, location[:-1])
        listed = f" Known: {', '.join(known)}." if known else ""
        return f"unknown key `{key}`.{did_you_mean(location[-1], known)}{listed}"
    if problem["type"] == "missing":
        return f"`{key}` is missing; add it."
    message = problem["msg"].removeprefix("Value error, ")
    came = "" if isinstance(problem["input"], Mapping) else f", got {problem['input']!r}"
    return f"`{key}`: {message[0].lower()}{message[1:]}{came}."


def _written_path(values: object, location: Sequence[str]) -> list[str]:
    """The location without the names of union members, which stand in no file."""
    path = []
    for part in location:
        inner = values.get(part) if isinstance(values, Mapping) else None
        if inner is None and part != location[-1]:
            continue
        path.append(part)
        values = inner
    return path


def _known_keys(model: type[BaseModel], path: Iterable[str]) -> list[str]:
    candidates = [model]
    for part in path:
        inner = []
        for candidate in candidates:
            field = candidate.model_fields.get(part)
            inner.extend(_models_in(field.annotation) if field else [])
            # A union's tag or a mapping's key stands in the path too: stay at the same models.
            if not field:
                inner.append(candidate)
        candidates = inner
    return list(dict.fromkeys(name for candidate in candidates for name in candidate.model_fields))


def _models_in(annotation) -> list[type[BaseModel]]:
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return [annotation]
    return [model for argument in typing.get_args(annotation) for model in _models_in(argument)]
