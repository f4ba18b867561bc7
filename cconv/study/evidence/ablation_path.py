"""Order the changes that turn the baseline into the best configuration, one hyperparameter at a time."""

from collections.abc import Mapping, Sequence

from cconv.errors import ConfigError
from cconv.study.declared.domains import SearchSpace
from cconv.study.evidence.surrogate import FEWEST_TRIALS, Surrogate, axes_of, coordinates, trials_at
from cconv.study.records.trials import TrialRecord


def ablation_order(
    records: Sequence[TrialRecord],
    space: SearchSpace,
    baseline: Mapping,
    best: Mapping,
    updates: int,
    seed: int = 0,
    *,
    useless_error: float,
) -> list[str]:
    """Order the hyperparameters in which two configurations differ: next is the one with the smallest predicted error.

    A hyperparameter that only one of the two has is not in the order: it is added or removed together with the one that
    it depends on.

    Source: the greedy path of Fawcett and Hoos, "Analysing differences between algorithm configurations through
    ablation", J. Heuristics 22 (2016), with predicted errors as in Biedenkapp et al., "Efficient Parameter Importance
    Analysis via Ablation with Surrogates", AAAI 2017. Only the order is predicted; errors along the path are measured.

    Args:
        records: Trials to fit the surrogate to.
        space: The space that they were drawn from.
        baseline: Configuration at the start.
        best: Configuration at the end.
        updates: Budget at which errors are taken.
        seed: Seed of the surrogate.
        useless_error: Error of predicting the mean; larger errors are replaced by it.

    Raises:
        ConfigError: If fewer than ten trials have an error after these updates.
    """
    trials, targets = trials_at(records, updates, useless_error=useless_error)
    if len(trials) < FEWEST_TRIALS:
        raise ConfigError(
            f"{len(trials)} trials have an error after {updates} updates; a surrogate needs {FEWEST_TRIALS}."
        )
    axes = axes_of(space)
    surrogate = Surrogate(axes, seed=seed).fit(coordinates(axes, [trial.parameters for trial in trials]), targets)
    left = [name for name in baseline if name in best and baseline[name] != best[name]]
    order: list[str] = []
    while left:
        candidates = [_between(baseline, best, [*order, name], space) for name in left]
        predicted = surrogate.predict(coordinates(axes, candidates))
        order.append(left.pop(int(predicted.argmin())))
    return order


def path_configurations(baseline: Mapping, best: Mapping, order: Sequence[str], space: SearchSpace) -> list[dict]:
    """List the baseline and the configuration after each change of the order; the last one is the best.

    A hyperparameter is added or removed together with those that it depends on. Its value is that of the configuration
    that has it.
    """
    return [_between(baseline, best, order[:count], space) for count in range(len(order) + 1)]


def _between(baseline: Mapping, best: Mapping, changed: Sequence[str], space: SearchSpace) -> dict:
    """Return the baseline with some hyperparameters as in the best configuration."""
    values = {name: parameter.baseline for name, parameter in space.parameters.items()} | dict(best) | dict(baseline)
    return space.active(values | {name: best[name] for name in changed})
