"""Search spaces: which hyperparameters vary, over what, and why. TOML, validated; see search_spaces/README.md."""

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field, ValidationError, model_validator

from cconv.errors import ConfigError, did_you_mean
from cconv.study.config import TrainingConfig, read_toml
from cconv.training.field_model import NetworkConfig
from cconv.validation import StrictModel, validated

Value = bool | int | float | str

TRAINING_HYPERPARAMETERS = ("batch_size", "learning_rate", "schedule")
HYPERPARAMETERS = (*NetworkConfig.model_fields, *TRAINING_HYPERPARAMETERS)


class Choice(StrictModel):
    """One of a few values, without order."""

    type: Literal["choice"]
    values: list[Value] = Field(min_length=1)
    baseline: Value
    reason: str

    @model_validator(mode="after")
    def _baseline_is_listed(self) -> "Choice":
        if self.baseline not in self.values:
            raise ValueError(f"the baseline {self.baseline!r} must be one of the values {self.values}")
        return self

    @property
    def extremes(self) -> list[Value]:
        """Values that must all be possible."""
        return self.values


class _Range(StrictModel):
    scale: Literal["linear", "log"] = "linear"
    reason: str

    @model_validator(mode="after")
    def _baseline_is_inside(self):
        low, high = self.range
        if not low < high:
            raise ValueError(f"the range [{low}, {high}] must have its lower end first")
        if self.scale == "log" and low <= 0:
            raise ValueError(f"the range [{low}, {high}] must be positive on a log scale")
        if not low <= self.baseline <= high:
            raise ValueError(f"the baseline {self.baseline} must lie in the range [{low}, {high}]")
        return self

    @property
    def extremes(self) -> list[Value]:
        """Values that must all be possible."""
        return list(self.range)


class IntRange(_Range):
    """A whole number, both ends included."""

    type: Literal["int"]
    range: tuple[int, int]
    baseline: int


class FloatRange(_Range):
    """A real number."""

    type: Literal["float"]
    range: tuple[float, float]
    baseline: float


Parameter = Annotated[Choice | IntRange | FloatRange, Field(discriminator="type")]


class SearchSpace(StrictModel):
    """A named set of hyperparameters and their domains."""

    name: str
    description: str
    parameters: dict[str, Parameter] = Field(min_length=1)

    @property
    def baseline(self) -> dict[str, Value]:
        """Baseline value of every parameter."""
        return {name: parameter.baseline for name, parameter in self.parameters.items()}


def load_space(path: Path | str) -> SearchSpace:
    """Search space from a TOML file.

    Raises:
        ConfigError: If the file cannot be read, names no hyperparameter of ours, or a value is impossible.
    """
    space = validated(SearchSpace, read_toml(path), path)
    for name, parameter in space.parameters.items():
        if name not in HYPERPARAMETERS:
            raise ConfigError(
                f"{path}: unknown hyperparameter `parameters.{name}`.{did_you_mean(name, HYPERPARAMETERS)} "
                f"Known: {', '.join(HYPERPARAMETERS)}."
            )
        for value in parameter.extremes:
            _check_possible(name, value, path)
    return space


def _check_possible(name: str, value: Value, path: Path | str) -> None:
    try:
        configure({name: value}, NetworkConfig(), TrainingConfig())
    except ValidationError as error:
        problem = error.errors()[0]["msg"]
        raise ConfigError(f"{path}: `parameters.{name}`: the value {value!r} is not possible ({problem}).") from error


def configure(
    parameters: Mapping[str, Value], network: NetworkConfig, training: TrainingConfig
) -> tuple[NetworkConfig, TrainingConfig]:
    """Network and training settings with the drawn hyperparameters in place of the study's own."""
    drawn = {name: value for name, value in parameters.items() if name in TRAINING_HYPERPARAMETERS}
    shape = {name: value for name, value in parameters.items() if name not in TRAINING_HYPERPARAMETERS}
    return (
        NetworkConfig.model_validate(network.model_dump() | shape),
        TrainingConfig.model_validate(training.model_dump() | drawn),
    )


def ray_domains(space: SearchSpace) -> dict:
    """The space as Ray Tune domains."""
    from ray import tune

    makers = {
        ("int", "linear"): lambda low, high: tune.randint(low, high + 1),
        ("int", "log"): lambda low, high: tune.lograndint(low, high + 1),
        ("float", "linear"): tune.uniform,
        ("float", "log"): tune.loguniform,
    }
    return {
        name: tune.choice(parameter.values)
        if isinstance(parameter, Choice)
        else makers[parameter.type, parameter.scale](*parameter.range)
        for name, parameter in space.parameters.items()
    }


def optuna_distributions(space: SearchSpace) -> dict:
    """The space as Optuna distributions."""
    from optuna.distributions import CategoricalDistribution, FloatDistribution, IntDistribution

    makers = {"int": IntDistribution, "float": FloatDistribution}
    return {
        name: CategoricalDistribution(parameter.values)
        if isinstance(parameter, Choice)
        else makers[parameter.type](*parameter.range, log=parameter.scale == "log")
        for name, parameter in space.parameters.items()
    }
