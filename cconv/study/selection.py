"""Which models to look at closer, and which one to recommend: no more than the scene needs."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from cconv.data.splits import evenly_spaced
from cconv.errors import DataError
from cconv.evaluation.statistics import PairedDifference, crossed_standard_error, paired_difference
from cconv.study.records import TrialRecord

SHOWN_FAILURES = 2  # of a model, in words
RULES = ("one_standard_error", "non_inferiority", "accurate_enough")


def pareto_front(points: Mapping[str, tuple[float, float]]) -> list[str]:
    """Names of the points that no other point beats in one value without losing in the other.

    Args:
        points: (error, cost) of each name; smaller is better.

    Returns:
        The front, cheapest first.
    """
    front: list[str] = []
    best_error = float("inf")
    for name, (error, _) in sorted(points.items(), key=lambda item: (item[1][1], item[1][0])):
        if error < best_error:
            front.append(name)
            best_error = error
    return front


def choose_finalists(
    records: Sequence[TrialRecord], cost: Mapping[str, float], count: int, accurate_enough: float | None = None
) -> list[TrialRecord]:
    """Configurations among those that none is both more accurate and cheaper than, most accurate first.

    The `count` most accurate ones; or, where more of them are accurate enough, `count` evenly spaced from the most
    accurate to the cheapest of those. Only trials of the full budget compete, by their last validation error.

    Args:
        records: Trials of the search.
        cost: Estimated cost of each trial by id, e.g. FLOPs per particle.
        count: Number of finalists.
        accurate_enough: Error below which cost alone matters; None for no such limit.
    """
    distinct: dict[str, TrialRecord] = {}
    for record in records:
        if record.outcome == "completed" and record.last is not None:
            distinct.setdefault(repr(sorted(record.parameters.items())), record)
    by_id = {record.id: record for record in distinct.values()}
    errors = {trial: record.last["valid_normalized_mse"] for trial, record in by_id.items()}
    front = pareto_front({trial: (errors[trial], cost[trial]) for trial in by_id})[::-1]
    enough = [trial for trial in front if accurate_enough is not None and errors[trial] <= accurate_enough]
    if len(enough) > count:
        front = [enough[place] for place in evenly_spaced(len(enough), count)]
    return [by_id[trial] for trial in front[:count]]


@dataclass(frozen=True, kw_only=True)
class Comparison:
    """A model beside the best one.

    Attributes:
        id: Its name.
        error: Mean test error over seeds and units.
        cost: ms per frame.
        to_best: Paired difference to the best model.
        within_one_se: Whether the difference is at most its standard error, and at most that of the best's own error.
        non_inferior: Whether the upper end of its interval is at most the margin.
        accurate_enough: Whether the error is at most the study's limit; False without one.
        failures: Checks of stability that it failed.
        eligible: Whether it may be recommended, by any rule.
        why_not: Why it may not, or "".
    """

    id: str
    error: float
    cost: float
    to_best: PairedDifference
    within_one_se: bool
    non_inferior: bool
    accurate_enough: bool
    failures: tuple[str, ...]
    eligible: bool
    why_not: str

    @property
    def stable(self) -> bool:
        """Whether it passed every check of stability."""
        return not self.failures

    def passes(self, rule: str) -> bool:
        """Whether it is as good as the best by one of `RULES`."""
        by_rule = (self.within_one_se, self.non_inferior, self.accurate_enough)
        return dict(zip(RULES, by_rule, strict=True))[rule]


@dataclass(frozen=True, kw_only=True)
class Recommendation:
    """The model to use, and why.

    Attributes:
        id: The recommended model.
        reason: The reason in words.
        best: The most accurate model of those chosen from.
        by_rule: The cheapest model that each of `RULES` alone would choose, None where it chooses none.
        comparisons: Every model beside the best, cheapest first.
    """

    id: str
    reason: str
    best: str
    by_rule: dict[str, str | None]
    comparisons: tuple[Comparison, ...]


def recommend(
    errors: Mapping[str, np.ndarray],
    cost: Mapping[str, float],
    failures: Mapping[str, Sequence[str]],
    *,
    accurate_enough: float | None = None,
    margin: float = 0.05,
) -> Recommendation:
    """The cheapest stable model that is as accurate as the best one, or accurate enough.

    As accurate is within one standard error of the best, or not inferior: the upper end of the BCa interval of the
    paired difference is within the margin. The standard error is that of the difference or that of the best model's own
    error, whichever is smaller: a model of which one seed failed would pass for its scatter alone. The best is the most
    accurate of the stable models; if none is stable, all are chosen from, and the reason says so.

    Sources: the one-standard-error rule of Breiman et al., "Classification and Regression Trees" (1984), section 3.4.3;
    Chen and Yang, "The One Standard Error Rule for Model Selection: Does It Work?", Stats 4 (2021).

    Args:
        errors: Test errors (seeds, units) by model, one row where no seed is drawn; seeds and units are the same.
        cost: ms per frame, by model.
        failures: Checks of stability that each model failed; those that failed none may be left out.
        accurate_enough: Error up to which models count as equally accurate; None for no such limit.
        margin: Margin of non-inferiority, as a share of the best error.

    Raises:
        DataError: If there is no model, or one has no cost.
    """
    missing = sorted(errors.keys() - cost.keys())
    if not errors or missing:
        raise DataError(f"a recommendation needs error and cost of each model; missing: {missing or 'every model'}.")
    means = {name: float(np.mean(values)) for name, values in errors.items()}
    stable = [name for name in errors if not failures.get(name)]
    best = min(stable or errors, key=lambda name: (means[name], cost[name]))
    limits = {
        "one_se": crossed_standard_error(np.asarray(errors[best], dtype=float))[0],
        "margin": margin * means[best],
        "accurate_enough": accurate_enough,
    }
    comparisons = tuple(
        _compare(name, errors, best, cost[name], tuple(failures.get(name, ())), any_stable=bool(stable), **limits)
        for name in sorted(errors, key=lambda name: (cost[name], means[name]))
    )
    eligible = [each for each in comparisons if each.eligible]
    by_rule = {rule: next((each.id for each in eligible if each.passes(rule)), None) for rule in RULES}
    words = [
        _choice(eligible[0], next(each for each in comparisons if each.id == best), comparisons, accurate_enough),
        _rules(eligible[0], by_rule, margin),
        _stability(eligible[0], comparisons),
    ]
    return Recommendation(
        id=eligible[0].id, reason=" ".join(words), best=best, by_rule=by_rule, comparisons=comparisons
    )


def _compare(
    name: str,
    errors: Mapping[str, np.ndarray],
    best: str,
    cost: float,
    failures: tuple[str, ...],
    *,
    any_stable: bool,
    one_se: float,
    margin: float,
    accurate_enough: float | None,
) -> Comparison:
    error, to_best = float(np.mean(errors[name])), paired_difference(errors[name], errors[best])
    good = {
        "within_one_se": to_best.difference <= min(to_best.standard_error, one_se),
        "non_inferior": to_best.ci95[1] <= margin,
        "accurate_enough": accurate_enough is not None and error <= accurate_enough,
    }
    unstable = any_stable and bool(failures)
    why_not = f"failed {_shortly(failures)}" if unstable else "" if any(good.values()) else "less accurate"
    return Comparison(
        id=name,
        error=error,
        cost=cost,
        to_best=to_best,
        failures=failures,
        eligible=not why_not,
        why_not=why_not,
        **good,
    )


def _choice(
    chosen: Comparison, best: Comparison, comparisons: Sequence[Comparison], accurate_enough: float | None
) -> str:
    figures = f"test error {chosen.error:.3g} at {chosen.cost:.3g} ms per frame"
    if chosen is best:
        cheaper = [each for each in comparisons if each.cost < best.cost]
        return f"{best.id} is the most accurate model ({figures}), and {_none_cheaper(best, cheaper)}."
    rules = {
        "one_standard_error": "within one standard error of the best",
        "non_inferiority": "not inferior to the best",
        "accurate_enough": f"accurate enough for this study (limit {accurate_enough})",
    }
    passed = " and ".join(words for rule, words in rules.items() if chosen.passes(rule))
    return (
        f"{chosen.id} is the cheapest model ({figures}) that is {passed}. The best is {best.id} with {best.error:.3g} "
        f"at {best.cost:.3g} ms per frame, {best.cost / chosen.cost:.3g} times the cost.{_ratio(chosen)}"
    )


def _none_cheaper(best: Comparison, cheaper: Sequence[Comparison]) -> str:
    if not cheaper:
        return "it is also the cheapest"
    if any(each.stable or not best.stable for each in cheaper):
        return "no cheaper one is as accurate"
    return "no cheaper one is stable"


def _ratio(chosen: Comparison) -> str:
    if chosen.to_best.ratio is None:
        return ""
    low, high = chosen.to_best.ratio_ci95
    interval = f"95 % interval {low:.3g} to {high:.3g}"
    return f" The error of {chosen.id} is {chosen.to_best.ratio:.3g} times that of the best ({interval})."


def _rules(chosen: Comparison, by_rule: Mapping[str, str | None], margin: float) -> str:
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
    causes = "; ".join(f"{each.id} ({_shortly(each.failures)})" for each in unstable)
    return (
        f"It passed every check of stability; {len(unstable)} of {len(comparisons)} models did not and were set aside: "
        f"{causes}."
    )


def _shortly(failures: Sequence[str]) -> str:
    more = len(failures) - SHOWN_FAILURES
    return "; ".join(failures[:SHOWN_FAILURES]) + (f"; and {more} more" if more > 0 else "")
