"""Search spaces: which hyperparameters vary, over what, when, and why. TOML, validated; see search_spaces/README.md."""

import json
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path

from cconv.errors import ConfigError, did_you_mean, shown
from cconv.files import read_toml
from cconv.networks import ARCHITECTURES
from cconv.networks.counting import CountedCost
from cconv.study.declared.configuration import (
    ARCHITECTURE,
    BY_INTEGRATOR,
    DEFAULTS,
    EXTERNAL_FORCE,
    HISTORY,
    HYPERPARAMETERS,
    NETWORK,
    Configuration,
    configure,
    known_hyperparameters,
)
from cconv.study.declared.domains import SearchSpace, Value
from cconv.study.declared.paths import below
from cconv.study.declared.stage import included
from cconv.study.declared.study_file import StudyConfig
from cconv.validation import validated


def load_space(path: Path | str, study: StudyConfig | None = None) -> SearchSpace:
    """Search space from a TOML file.

    Args:
        path: The file.
        study: The study whose settings the space varies; the defaults if None.

    Raises:
        ConfigError: If the file cannot be read, names no hyperparameter of ours, or a value, condition or the baseline
            is impossible.
    """
    space = validated(SearchSpace, read_toml(path), path)
    check_possible(space, path, study)
    return space


def study_space(study: StudyConfig) -> SearchSpace:
    """The search space that a study names, with the study's own baseline.

    Raises:
        ConfigError: As `load_space`; also if the study gives a hyperparameter that is not in the space, or a value
            outside its domain.
    """
    space, parameters = load_space(study.search.space, study), {}
    if not study.search.baseline:
        return space
    for name, value in study.search.baseline.items():
        setting = f"`search.baseline.{name}`"
        if name not in space.parameters:
            raise ConfigError(
                f"{setting}: no such parameter in {study.search.space}.{did_you_mean(name, space.parameters)}"
            )
        domain = space.parameters[name]
        parameters[name] = validated(type(domain), domain.model_dump() | {"baseline": value}, setting)
    own = space.model_copy(update={"parameters": space.parameters | parameters})
    check_possible(own, "`search.baseline`", study)
    return own


def check_possible(space: SearchSpace, source: Path | str, study: StudyConfig | None = None) -> None:
    """Check that every parameter is a hyperparameter, and that its values and the baseline are possible.

    Args:
        space: The search space.
        source: Where it comes from, for the message.
        study: The study whose settings the space varies; the defaults if None.

    Raises:
        ConfigError: With the parameter and the value.
    """
    configured = study.configured if study else partial(configure, defaults=DEFAULTS)
    for name, parameter in space.parameters.items():
        if name not in HYPERPARAMETERS:
            raise ConfigError(f"{source}: unknown hyperparameter `parameters.{name}`.{known_hyperparameters(name)}")
        for value in parameter.extremes:
            values = space.making_active(name) | {name: value}
            _check_configures(values, configured, f"{source}: `parameters.{name}`: the value {shown(value)}")
    _check_conditions_on_architectures(space, source)
    _check_configures(space.baseline, configured, f"{source}: the baseline")


def longest_history(space: SearchSpace, study: StudyConfig) -> int:
    """The longest history of all configurations of a study, so that their windows can have the same presents."""
    drawn = space.parameters[HISTORY].extremes if HISTORY in space.parameters else []
    named = [parameters.get(HISTORY) for _, parameters in included(study.stages)]
    histories = [study.task.usual_history, *drawn, *named]
    return max(history for history in histories if isinstance(history, int))


def may_add_force(space: SearchSpace, study: StudyConfig) -> bool:
    """Tell whether the integrator adds the external force in a configuration of a study."""
    searched = space.parameters[EXTERNAL_FORCE].extremes if EXTERNAL_FORCE in space.parameters else []
    named = [parameters.get(EXTERNAL_FORCE) for _, parameters in included(study.stages)]
    return BY_INTEGRATOR in (study.task.external_force, *searched, *named)


def _check_conditions_on_architectures(space: SearchSpace, source: Path | str) -> None:
    """Check that a setting of some architectures alone is active with these alone."""
    searched = space.parameters.get(ARCHITECTURE)
    for architecture in getattr(searched, "values", ()):
        for setting in below(NETWORK, space.parameters).keys() - ARCHITECTURES[architecture].model_fields.keys():
            name = f"{NETWORK}.{setting}"
            if space.is_active(name, space.making_active(name) | {ARCHITECTURE: architecture}):
                owners = [each for each, settings in ARCHITECTURES.items() if setting in settings.model_fields]
                raise ConfigError(
                    f"{source}: `parameters.{name}`: is no setting of {architecture}, which the space searches too; "
                    f"give it `when = {{ {ARCHITECTURE} = {json.dumps(owners)} }}`."
                )


def _check_configures(
    parameters: Mapping[str, Value], configured: Callable[[Mapping[str, Value]], Configuration], what: str
) -> None:
    try:
        configured(parameters)
    except ConfigError as error:
        raise ConfigError(f"{what} is {error}.") from error


def check_baseline_affordable(space: SearchSpace, cost_of: Callable[[Mapping[str, Value]], CountedCost]) -> None:
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
