"""The choice of the finalists, and of the model to recommend: the fastest that is accurate and stable enough."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from cconv.data.splits import evenly_spaced
from cconv.errors import DataError
from cconv.evaluation.statistics import (
    PairedRatio,
    crossed_standard_error,
    paired_logarithms,
    paired_ratio,
    why_no_interval,
)
from cconv.study.evidence.front import Timing, pareto_front
from cconv.study.records.summary import ExpectedError
from cconv.study.records.trials import TrialRecord, identity

SHOWN_FAILURES = 2  # of a model, in words
RULES = ("one_standard_error", "non_inferiority", "accurate_enough")


def choose_finalists(
    records: Sequence[TrialRecord], cost: Mapping[str, float], count: int, accurate_enough: float | None = None
) -> list[TrialRecord]:
    """Choose configurations on the Pareto front of validation error and cost, most accurate first.

    They are the `count` most accurate ones; or, if more are accurate enough, `count` evenly spaced ones from the most
    accurate to the cheapest of those. Only trials of the full budget compete, by their last validation error.

    Args:
        records: Trials of the search.
        cost: Estimated cost of each trial by id, e.g. FLOPs per particle.
        count: Number of finalists.
        accurate_enough: Error below which cost alone matters; None for no such limit.
    """
    distinct: dict[str, tuple[TrialRecord, float]] = {}
    for record in records:
        if (error := record.final_error) is not None:
            distinct.setdefault(identity(record.parameters), (record, error))
    by_id = {record.id: record for record, _ in distinct.values()}
    errors = {record.id: error for record, error in distinct.values()}
    front = pareto_front({trial: (errors[trial], cost[trial]) for trial in by_id})[::-1]
    enough = [trial for trial in front if accurate_enough is not None and errors[trial] <= accurate_enough]
    if len(enough) > count:
        front = [enough[place] for place in evenly_spaced(len(enough), count)]
    return [by_id[trial] for trial in front[:count]]


@dataclass(frozen=True, kw_only=True)
class Comparison:
    """A model compared with the best one by validation errors.

    Attributes:
        id: Name of the model.
        error: Mean validation error over seeds and units.
        time: Time of each turn, ms per frame.
        to_best: Ratio of its errors to those of the best model on the same seeds and units.
        within_one_se: True if the logarithm of that ratio is at most its standard error and that of the best error.
        non_inferior: True if the upper end of the interval of the ratio is at most 1 + the margin; False without one.
        accurate_enough: True if the error is at most the limit of the study; False without a limit.
        failures: Checks of stability that the model failed.
        eligible: True if it may be recommended.
        why_not: The reason why it may not be recommended, or "".
    """

    id: str
    error: float
    time: Timing
    to_best: PairedRatio
    within_one_se: bool
    non_inferior: bool
    accurate_enough: bool
    failures: tuple[str, ...]
    eligible: bool
    why_not: str

    @property
    def stable(self) -> bool:
        """True if the model passed every check of stability."""
        return not self.failures

    def passes(self, rule: str) -> bool:
        """Tell whether it is as good as the best model by one of `RULES`."""
        by_rule = (self.within_one_se, self.non_inferior, self.accurate_enough)
        return dict(zip(RULES, by_rule, strict=True))[rule]


@dataclass(frozen=True, kw_only=True)
class Recommendation:
    """The recommended model and the reason for it.

    Attributes:
        id: The recommended model.
        reason: The reason in words.
        best: The most accurate of the stable models on the validation split, or of all if none is stable.
        tied: Eligible models that are as fast as the fastest one within the noise of the timing, including that one; of
            these, the recommended one has the smallest validation error.
        by_rule: The model that each of `RULES` alone would choose; None if it chooses none.
        comparisons: Every model compared with the best, fastest first.
    """

    id: str
    reason: str
    best: str
    tied: tuple[str, ...]
    by_rule: dict[str, str | None]
    comparisons: tuple[Comparison, ...]


def recommend(
    errors: Mapping[str, np.ndarray],
    times: Mapping[str, Timing],
    failures: Mapping[str, Sequence[str]],
    *,
    accurate_enough: float | None = None,
    margin: float = 0.05,
) -> Recommendation:
    """Choose the fastest stable model that is as accurate as the best one, or accurate enough.

    The choice uses validation errors. The error of a model on the units that it was chosen by is biased: it is too
    small on average, because the model was chosen for being good on these units. So the test split is kept for
    reporting the error of the chosen model. The validation errors also chose the finalists and the checkpoints, which
    is one more reason not to report them.

    A model is as accurate as the best one if it is within one standard error of it or not inferior, that is, if the
    upper end of the 95 % interval of the ratio of errors is within the margin. The standard error is that of the ratio
    or that of the best model's own error, whichever is smaller; otherwise a model with one bad seed would pass because
    of its own large variance. The best model is the most accurate of the stable ones. If none is stable, the choice is
    among all, and the reason says so. Models whose times differ by no more than the noise of the timing are ties; the
    one with the smallest error is chosen.

    Sources: the one-standard-error rule of Breiman et al., "Classification and Regression Trees" (1984), section 3.4.3;
    Chen and Yang, "The One Standard Error Rule for Model Selection: Does It Work?", Stats 4 (2021).

    Args:
        errors: Validation errors (seeds, units) by model on the same seeds and units; one row for a closed form.
        times: Time of each model.
        failures: Checks of stability that each model failed; models that passed all may be left out.
        accurate_enough: Error up to which all models are accurate enough; None for no such limit.
        margin: Margin of non-inferiority, as a share of the best error.

    Raises:
        DataError: If there is no model, or one has no time.
    """
    missing = sorted(errors.keys() - times.keys())
    if not errors or missing:
        raise DataError(f"a recommendation needs error and time of each model; missing: {missing or 'every model'}.")
    comparisons = _comparisons(errors, times, failures, accurate_enough, margin)
    eligible = [each for each in comparisons if each.eligible]
    tied = _as_fast_as_the_first(eligible)
    chosen = min(tied, key=lambda each: each.error)
    by_rule = {rule: _fastest_by(rule, eligible) for rule in RULES}
    best = next(each for each in comparisons if each.id == _best(errors, times, failures))
    words = [
        _choice(chosen, best, comparisons, tied, accurate_enough),
        _tie(chosen, tied),
        _rules(chosen, by_rule, margin, _why_no_interval(errors)),
        _stability(chosen, comparisons),
    ]
    return Recommendation(
        id=chosen.id,
        reason=" ".join(filter(None, words)),
        best=best.id,
        tied=tuple(each.id for each in tied),
        by_rule=by_rule,
        comparisons=comparisons,
    )


def retrained_error(
    valid: Mapping[str, np.ndarray], test: Mapping[str, np.ndarray], choose: Callable[[Mapping], str]
) -> ExpectedError | None:
    """Estimate the error of the chosen model if it is trained again with other seeds than those that it was chosen by.

    Validation and test errors of a model come from the same trained networks. The mean test error is unbiased for these
    networks. But if errors vary more over seeds than over models, the choice prefers models whose seeds happened to be
    good. So each seed in turn is left out: a model is chosen by the validation errors of the other seeds, and its test
    error is taken with the seed that was left out.

    Args:
        valid: Validation errors (seeds, units) by model; one row for a closed form.
        test: Test errors, likewise.
        choose: Function from validation errors to the name of the chosen model.

    Returns:
        The mean error over the seeds, and how often each model was chosen; None without several seeds.
    """
    seeds = max(len(table) for table in valid.values())
    if seeds < 2:
        return None
    found = []
    for seed in range(seeds):
        kept = {name: table if len(table) == 1 else np.delete(table, seed, axis=0) for name, table in valid.items()}
        name = choose(kept)
        found.append((name, float(test[name][seed % len(test[name])].mean())))
    names = [name for name, _ in found]
    return ExpectedError(
        error=float(np.mean([error for _, error in found])),
        choices={name: names.count(name) for name in dict.fromkeys(names)},
    )


def _best(errors: Mapping[str, np.ndarray], times: Mapping[str, Timing], failures: Mapping) -> str:
    """Return the most accurate of the stable models, or of all if none is stable."""
    stable = [name for name in errors if not failures.get(name)]
    return min(stable or errors, key=lambda name: (float(np.mean(errors[name])), times[name].ms))


def _comparisons(
    errors: Mapping[str, np.ndarray],
    times: Mapping[str, Timing],
    failures: Mapping[str, Sequence[str]],
    accurate_enough: float | None,
    margin: float,
) -> tuple[Comparison, ...]:
    """Compare every model with the best, fastest first."""
    best = _best(errors, times, failures)
    own_se = crossed_standard_error(paired_logarithms([errors[best]])[0])[0]
    none_stable = bool(failures.get(best))
    comparisons = []
    for name in sorted(errors, key=lambda name: (times[name].ms, float(np.mean(errors[name])))):
        error, to_best = float(np.mean(errors[name])), paired_ratio(errors[name], errors[best])
        within_one_se = to_best.log_ratio <= min(to_best.log_standard_error, own_se)
        non_inferior = name == best or (to_best.ci95 is not None and to_best.ci95[1] <= 1 + margin)
        enough = accurate_enough is not None and error <= accurate_enough
        failed = tuple(failures.get(name, ()))
        less_accurate = "" if within_one_se or non_inferior or enough else "less accurate"
        why_not = f"failed {_shortly(failed)}" if failed and not none_stable else less_accurate
        comparisons.append(
            Comparison(
                id=name,
                error=error,
                time=times[name],
                to_best=to_best,
                within_one_se=within_one_se,
                non_inferior=non_inferior,
                accurate_enough=enough,
                failures=failed,
                eligible=not why_not,
                why_not=why_not,
            )
        )
    return tuple(comparisons)


def _as_fast_as_the_first(comparisons: Sequence[Comparison]) -> list[Comparison]:
    """Return the models that are not slower than the first one, the fastest, beyond the noise of the timing."""
    return [each for each in comparisons if not each.time.is_slower(comparisons[0].time)]


def _fastest_by(rule: str, eligible: Sequence[Comparison]) -> str | None:
    """Return the model that a rule alone would choose."""
    passing = [each for each in eligible if each.passes(rule)]
    return min(_as_fast_as_the_first(passing), key=lambda each: each.error).id if passing else None


def _choice(
    chosen: Comparison,
    best: Comparison,
    comparisons: Sequence[Comparison],
    tied: Sequence[Comparison],
    accurate_enough: float | None,
) -> str:
    figures = f"validation error {chosen.error:.3g} at {chosen.time.ms:.3g} ms per frame"
    if chosen is best:
        faster = [each for each in comparisons if best.time.is_slower(each.time)]
        return f"{best.id} is the most accurate model ({figures}), and {_none_faster(best, faster)}."
    rules = {
        "one_standard_error": "within one standard error of the best",
        "non_inferiority": "not inferior to the best",
        "accurate_enough": f"accurate enough for this study (limit {accurate_enough})",
    }
    passed = " and ".join(words for rule, words in rules.items() if chosen.passes(rule))
    cheapest = (
        f"the cheapest model ({figures}) that is" if len(tied) == 1 else f"among the cheapest ({figures}) that are"
    )
    return (
        f"{chosen.id} is {cheapest} {passed}. The best is {best.id} with {best.error:.3g} "
        f"at {best.time.ms:.3g} ms per frame, {best.time.ms / chosen.time.ms:.3g} times the cost.{_ratio(chosen)}"
    )


def _none_faster(best: Comparison, faster: Sequence[Comparison]) -> str:
    if not faster:
        return "none is cheaper beyond the noise of the timing"
    if any(each.stable or not best.stable for each in faster):
        return "no cheaper one is as accurate"
    return "no cheaper one is stable"


def _ratio(chosen: Comparison) -> str:
    compared = chosen.to_best
    low, high = compared.ci95 or (None, None)
    interval = "" if low is None else f" (95 % interval {low:.3g} to {high:.3g})"
    return f" The validation error of {chosen.id} is {compared.ratio:.3g} times that of the best{interval}."


def _tie(chosen: Comparison, tied: Sequence[Comparison]) -> str:
    others = [each.id for each in tied if each is not chosen]
    if not others:
        return ""
    return (
        f"Within the noise of the timing {chosen.id} is as fast as {', '.join(others)}; of these, it has the smallest "
        "validation error."
    )


def _why_no_interval(errors: Mapping[str, np.ndarray]) -> str:
    return why_no_interval(max(len(table) for table in errors.values()), next(iter(errors.values())).shape[1])


def _rules(chosen: Comparison, by_rule: Mapping[str, str | None], margin: float, why_not: str) -> str:
    if why_not:
        return f"Non-inferiority cannot be tested: {why_not}."
    one_se, non_inferior = by_rule["one_standard_error"], by_rule["non_inferiority"]
    names = f"one standard error and non-inferiority (margin {100 * margin:g} %)"
    if one_se == non_inferior:
        return f"The rules of {names} both choose {'it' if one_se == chosen.id else one_se}."
    return f"Of the rules of {names}, the first alone would choose {one_se}, the second {non_inferior}."


def _stability(chosen: Comparison, comparisons: Sequence[Comparison]) -> str:
    if not chosen.stable:
        return (
            "No model passed every check of stability, so all were chosen from; see what failed before use: "
            f"{_shortly(chosen.failures)}."
        )
    unstable = [each for each in comparisons if not each.stable]
    if not unstable:
        return "Every model passed every check of stability."
    return (
        f"It passed every check of stability; {len(unstable)} of {len(comparisons)} models did not and were set aside."
    )


def _shortly(failures: Sequence[str]) -> str:
    more = len(failures) - SHOWN_FAILURES
    return "; ".join(failures[:SHOWN_FAILURES]) + (f"; and {more} more" if more > 0 else "")
