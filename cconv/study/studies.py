"""Studies with stages of the kinds in `stages.STAGES`: from a study file, and from the folder of a run."""

import tomllib
from collections.abc import Sequence
from pathlib import Path
from types import GenericAlias
from typing import Annotated, Any, ClassVar, Union

from pydantic import Field, create_model

from cconv.errors import LONGEST_SHOWN, ConfigError, DataError, visible
from cconv.files import DEEPEST, parse_toml, read_toml
from cconv.study.declared.domains import SearchSpace
from cconv.study.declared.stage import Stage, kind_of
from cconv.study.declared.study_file import StudyConfig, task_table
from cconv.study.records.run_folder import RunFolder
from cconv.study.stages import STAGES
from cconv.study.stages.closed_form import ClosedFormStage
from cconv.study.stages.finalists import FinalistsStage
from cconv.study.stages.random import RandomStage
from cconv.study.stages.select import SelectStage
from cconv.validation import Name, validated


def default_stages() -> dict[str, Stage]:
    """The shortest study that answers: closed forms, a random search, finalists, selection."""
    return {stage.kind: stage for stage in (ClosedFormStage(), RandomStage(), FinalistsStage(), SelectStage())}


def study_form(stages: Sequence[type[Stage]]) -> type[StudyConfig]:
    """The form of a study file that can ask for these classes of stages; at least two."""
    any_stage: Any = Annotated[Union[tuple(stages)], Field(discriminator="kind")]  # noqa: UP007, the members are a list
    by_name: Any = GenericAlias(dict, (Name, any_stage))
    return create_model(
        "Study",
        __base__=StudyConfig,
        __module__=__name__,
        kinds=(ClassVar[tuple[str, ...]], tuple(map(kind_of, stages))),
        stages=(by_name, Field(default_factory=default_stages, min_length=1, max_length=100)),
    )


Study = study_form(STAGES)


def recorded_study(run: RunFolder) -> StudyConfig:
    """The study of a run folder.

    Raises:
        DataError: If its study.json is damaged.
    """
    values = {key: value for key, value in run.read("study.json").items() if key not in ("format", "id")}
    return validated(Study, values, run.path / "study.json", DataError)


def recorded_space(run: RunFolder) -> SearchSpace:
    """The search space of a run folder.

    Raises:
        DataError: If its space.json is damaged.
    """
    return validated(SearchSpace, run.read("space.json"), run.path / "space.json", DataError)


def load_study(path: Path | str, overrides: Sequence[str] = ()) -> StudyConfig:
    """Study from a TOML file; its search space is looked for beside the file, then in the working folder.

    Args:
        path: The study file.
        overrides: Settings that replace the file's, as ``"training.updates=100"``; values in TOML or plain text.

    Raises:
        ConfigError: If the file cannot be read or a key or value does not fit.
    """
    path = Path(path)
    values = read_toml(path)
    if "task" in values:
        values["task"] = task_table(values["task"])  # so that settings of it can be replaced
    for override in overrides:
        _apply(values, override)
    study = validated(Study, values, path)
    space = path.parent / study.search.space
    if space.is_file():
        study = study.model_copy(update={"search": study.search.model_copy(update={"space": str(space)})})
    return study


def _apply(values: dict, override: str) -> None:
    name, equals, text = override.partition("=")
    setting = f"--set {visible(override)[:LONGEST_SHOWN]}"
    if not equals:
        raise ConfigError(f"{setting}: must read key=value, e.g. training.updates=100.")
    if name.count(".") >= DEEPEST:
        raise ConfigError(f"{setting}: a key of more than {DEEPEST} parts; see the study file for its keys.")
    *tables, key = name.strip().split(".")
    for table in tables:
        values = values.setdefault(table, {})
        if not isinstance(values, dict):
            raise ConfigError(f"{setting}: `{table}` is not a table; see the study file for its keys.")
    values[key] = _value(text, setting)


def _value(text: str, setting: str) -> object:
    """A value in TOML, or else the text itself."""
    if "\n" in text:
        raise ConfigError(f"{setting}: must be one line.")
    try:
        return parse_toml(f"value = {text}")["value"]
    except tomllib.TOMLDecodeError:
        return text
    except ValueError as error:
        raise ConfigError(f"{setting}: no value for a setting ({error}).") from error
