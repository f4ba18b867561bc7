"""Search spaces: which hyperparameters vary, over what, when, and why. TOML, validated; see search_spaces/README.md."""

from collections.abc import Callable, Mapping
from pathlib import Path

from pydantic import ValidationError

from cconv.errors import ConfigError, did_you_mean
from cconv.evaluation.cost_model import Estimate
from cconv.study.config import TrainingConfig, read_toml
from cconv.study.domains import Choice, FloatRange, IntRange, Parameter, SearchSpace, Value, fixed, narrowed
from cconv.training.field_model import NetworkConfig
from cconv.validation import validated

__all__ = [
    "HYPERPARAMETERS",
    "Choice",
    "FloatRange",
    "IntRange",
    "Parameter",
    "SearchSpace",
    "Value",
    "check_baseline_affordable",
    "configure",
    "fixed",
    "load_space",
    "narrowed",
]

TRAINING_HYPERPARAMETERS = ("batch_size", "learning_rate", "schedule")
HYPERPARAMETERS = (*NetworkConfig.model_fields, *TRAINING_HYPERPARAMETERS)


def load_space(path: Path | str) -> SearchSpace:
    """Search space from a TOML file.

    Raises:
        ConfigError: If the file cannot be read, names no hyperparameter of ours, or a value, condition or the baseline
            is impossible.
    """
    space = validated(SearchSpace, read_toml(path), path)
    for name, parameter in space.parameters.items():
        if name not in HYPERPARAMETERS:
            raise ConfigError(
                f"{path}: unknown hyperparameter `parameters.{name}`.{did_you_mean(name, HYPERPARAMETERS)} "
                f"Known: {', '.join(HYPERPARAMETERS)}."
            )
        for value in parameter.extremes:
            _check_possible({name: value}, f"{path}: `parameters.{name}`: the value {value!r}")
    _check_possible(space.baseline, f"{path}: the baseline")
    return space


def _check_possible(parameters: Mapping[str, Value], what: str) -> None:
    try:
        configure(parameters, NetworkConfig(), TrainingConfig())
    except ValidationError as error:
        raise ConfigError(f"{what} is not possible ({error.errors()[0]['msg']}).") from error


def check_baseline_affordable(space: SearchSpace, cost_of: Callable[[Mapping[str, Value]], Estimate]) -> None:
    """Refuse a space whose own baseline costs more than its caps, once the scene is known.

    Args:
        space: The search space.
        cost_of: Cost of one particle's prediction by a configuration.

    Raises:
        ConfigError: If the baseline is above a cap.
    """
    for name, cap in space.caps.items():
        cost = getattr(cost_of(space.baseline), name)
        if cost > cap:
            raise ConfigError(
                f"search space {space.name!r}: its baseline costs {cost:.3g} {name.replace('_', ' ')} in this scene, "
                f"above `max_{name}` = {cap:.3g}; raise the cap or take a cheaper baseline."
            )


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
