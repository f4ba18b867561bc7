"""The choice of the configurations of a search, from seed, number and records alone, so that it can be resumed."""

import math
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, cast

import numpy as np

from cconv.errors import ConfigError
from cconv.study.declared.domains import Choice, IntRange, Parameter, SearchSpace, Value
from cconv.study.records.trials import TrialRecord

if TYPE_CHECKING:
    from optuna import Study, Trial
    from optuna.distributions import BaseDistribution
    from optuna.trial import FrozenTrial

Affordable = Callable[[dict[str, Value]], bool]

MAX_DRAWS = 1000
MAX_PROPOSALS = 16  # of the sampler, before a random configuration replaces them
STARTUP_TRIALS = 8
UNBEARABLE = 1e3  # scalarised value of a trial that diverged or is too expensive; other values are of order one
AUGMENTATION = 0.05


def draw(space: SearchSpace, rng: np.random.Generator) -> dict[str, Value]:
    """Draw a random configuration of active parameters, each uniformly on its scale."""
    drawn: dict[str, Value] = {}
    for name in space.parents_first:
        if space.is_active(name, drawn):
            drawn[name] = _draw_value(space.parameters[name], rng)
    return space.active(drawn)


def _draw_value(parameter: Parameter, rng: np.random.Generator) -> Value:
    if isinstance(parameter, Choice):
        return parameter.values[rng.integers(len(parameter.values))]
    half = 0.5 if parameter.type == "int" else 0.0  # a whole number represents the interval around it
    low, high = parameter.range[0] - half, parameter.range[1] + half
    value = math.exp(rng.uniform(math.log(low), math.log(high))) if parameter.scale == "log" else rng.uniform(low, high)
    value = round(value) if parameter.type == "int" else value
    return min(max(value, parameter.range[0]), parameter.range[1])


def random_parameters(space: SearchSpace, seed: int, index: int, affordable: Affordable) -> dict[str, Value]:
    """Draw configuration number `index` of a random search; it does not depend on the ones before.

    Args:
        space: The search space.
        seed: Seed of the search.
        index: Number of the configuration.
        affordable: Function that tells whether a configuration is below the space's caps on cost.

    Raises:
        ConfigError: If hardly any configuration is affordable.
    """
    return _draw_affordable(space, np.random.default_rng([seed, index]), affordable)


def _draw_affordable(space: SearchSpace, rng: np.random.Generator, affordable: Affordable) -> dict[str, Value]:
    for _ in range(MAX_DRAWS):
        parameters = draw(space, rng)
        if affordable(parameters):
            return parameters
    raise ConfigError(
        f"search space {space.name!r}: none of {MAX_DRAWS} random configurations is below its caps ({_caps(space)}); "
        "raise a cap or narrow the space."
    )


def _caps(space: SearchSpace) -> str:
    return ", ".join(f"`max_{name}` = {cap:g}" for name, cap in space.caps.items())


def suggest_parameters(
    space: SearchSpace,
    records: Sequence[TrialRecord],
    *,
    number: int,
    seed: int,
    full_updates: int,
    affordable: Affordable,
    costs: Mapping[str, float],
    useless_error: float,
) -> dict[str, Value]:
    """Propose configuration number `number` of an adaptive search for small error and cost, from the earlier trials.

    A tree-structured Parzen estimator (Watanabe, arXiv 2304.11127) minimises an augmented Chebyshev norm of error and
    cost. Its weights change from proposal to proposal, so that the whole Pareto front is searched (Knowles, "ParEGO",
    IEEE TEVC 10, 2006). Only trials of the full budget are complete; the others are pruned at their last evaluation.
    Records whose parameters are no configuration of the space are left out.

    Args:
        space: The search space.
        records: Earlier trials, finished or not.
        number: Number of the proposal, which determines the weights.
        seed: Seed of the search.
        full_updates: Budget of a trial that was never stopped.
        affordable: Function that tells whether a configuration is below the space's caps on cost.
        costs: FLOPs per particle of each trial, by id.
        useless_error: Error of predicting the mean; larger errors are replaced by it.

    Raises:
        ConfigError: If hardly any configuration is affordable.
    """
    known = [record for record in records if space.holds(record.parameters)]
    scalarize = _Scalarization.of(known, costs, error_weight(number), useless_error)
    distributions = {name: _distribution(parameter) for name, parameter in space.parameters.items()}
    study = _study_in_memory(int(np.random.SeedSequence([seed, number]).generate_state(1)[0]))
    study.add_trials([_as_optuna(record, distributions, full_updates, costs, scalarize) for record in known])
    for parameters in _proposals(study, space):
        if affordable(parameters):
            return parameters
    return _draw_affordable(
        space, np.random.default_rng([seed, number, 1]), affordable
    )  # other draws than those of a random search


def error_weight(number: int) -> float:
    """Return the weight of the error in proposal `number`: 1 for the first, then evenly spread over (1/2, 1].

    It is 1 minus half of the van der Corput sequence in base 2.
    """
    digits = f"{number:b}"[::-1]
    return 1 - 0.5 * sum(int(digit) / 2**place for place, digit in enumerate(digits, start=1))


@dataclass(frozen=True)
class _Scalarization:
    """The augmented Chebyshev norm of log10 error and log10 cost, which are scaled to 0 to 1 over the records."""

    log_errors: tuple[float, float]
    log_costs: tuple[float, float]
    error_weight: float
    useless_error: float  # that of predicting the mean; it does not matter how much worse a model is

    @classmethod
    def of(
        cls, records: Sequence[TrialRecord], costs: Mapping[str, float], error_weight: float, useless_error: float
    ) -> "_Scalarization":
        known = [error for record in records if (error := record.last_error) is not None]
        of_errors = _log_span([min(error, useless_error) for error in known])
        return cls(of_errors, _log_span([costs[record.id] for record in records]), error_weight, useless_error)

    def __call__(self, error: float, cost: float) -> float:
        terms = (
            self.error_weight * _position(min(error, self.useless_error), self.log_errors),
            (1 - self.error_weight) * _position(cost, self.log_costs),
        )
        return max(terms) + AUGMENTATION * sum(terms)


def _log_span(values: Sequence[float]) -> tuple[float, float]:
    logs = [_log(value) for value in values]
    return (min(logs), max(logs)) if logs else (0.0, 0.0)


def _position(value: float, span: tuple[float, float]) -> float:
    low, high = span
    return (_log(value) - low) / (high - low) if high > low else 0.0


def _log(value: float) -> float:
    return math.log10(max(value, 1e-30))


def distributions_of(space: SearchSpace, parameters: Mapping[str, Value]) -> dict[str, "BaseDistribution"]:
    """Return the Optuna distributions of the parameters of a configuration."""
    return {name: _distribution(space.parameters[name]) for name in parameters}


def _distribution(parameter: Parameter) -> "BaseDistribution":
    from optuna.distributions import CategoricalDistribution, FloatDistribution, IntDistribution

    if isinstance(parameter, Choice):
        return CategoricalDistribution(parameter.values)
    log = parameter.scale == "log"
    if isinstance(parameter, IntRange):
        return IntDistribution(*parameter.range, log=log)
    return FloatDistribution(*parameter.range, log=log)


def _study_in_memory(seed: int) -> "Study":
    import optuna

    optuna.logging.set_verbosity(optuna.logging.WARNING)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", optuna.exceptions.ExperimentalWarning)  # of `group`
        sampler = optuna.samplers.TPESampler(
            n_startup_trials=STARTUP_TRIALS,
            n_ei_candidates=24,
            seed=seed,
            multivariate=True,
            group=True,
            constant_liar=True,
        )
    return optuna.create_study(direction="minimize", sampler=sampler)


def _as_optuna(
    record: TrialRecord,
    distributions: Mapping[str, "BaseDistribution"],
    full_updates: int,
    costs: Mapping[str, float],
    scalarize: _Scalarization,
) -> "FrozenTrial":
    """Convert a record to a trial of Optuna; one that diverged ranks behind all that were stopped."""
    from optuna.trial import TrialState, create_trial

    values = {
        entry["updates"]: scalarize(entry["valid_error"], costs[record.id])
        for entry in record.log
        if entry["valid_error"] is not None
    }
    complete = record.outcome == "completed" and full_updates in values
    states = {"interrupted": TrialState.RUNNING, "failed": TrialState.FAIL}
    return create_trial(
        state=TrialState.COMPLETE if complete else states.get(record.outcome, TrialState.PRUNED),
        value=values[full_updates] if complete else None,
        params=dict(record.parameters),
        distributions={name: distributions[name] for name in record.parameters},
        intermediate_values={0: UNBEARABLE} if record.outcome == "diverged" else values,
    )


def _proposals(study: "Study", space: SearchSpace) -> Iterator[dict[str, Value]]:
    """Yield proposals of the sampler; one that is not taken is recorded as unbearable for the next one."""
    from optuna.trial import TrialState

    for _ in range(MAX_PROPOSALS):
        trial = study.ask()
        proposed: dict[str, Value] = {}
        for name in space.parents_first:
            if space.is_active(name, proposed):
                proposed[name] = _suggest(trial, name, space.parameters[name])
        yield space.active(proposed)
        trial.report(UNBEARABLE, 0)
        study.tell(trial, state=TrialState.PRUNED)


def _suggest(trial: "Trial", name: str, parameter: Parameter) -> Value:
    if isinstance(parameter, Choice):
        return cast(
            Value, trial.suggest_categorical(name, parameter.values)
        )  # one of the values, none of which is None
    suggest = trial.suggest_int if parameter.type == "int" else trial.suggest_float
    return suggest(name, *parameter.range, log=parameter.scale == "log")
