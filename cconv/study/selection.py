"""Which models to look at closer, and which one to recommend: no more than the scene needs."""

from collections.abc import Collection, Mapping, Sequence

from cconv.study.records import TrialRecord


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


def choose_finalists(records: Sequence[TrialRecord], cost: Mapping[str, float], count: int) -> list[TrialRecord]:
    """The `count` most accurate configurations among those that none is both more accurate and cheaper than.

    Only trials of the full budget compete, by their last validation error.

    Args:
        records: Trials of the search.
        cost: Estimated cost of each trial by id, e.g. FLOPs per particle.
        count: Number of finalists.
    """
    distinct: dict[str, TrialRecord] = {}
    for record in records:
        if record.outcome == "completed" and record.last is not None:
            distinct.setdefault(repr(sorted(record.parameters.items())), record)
    by_id = {record.id: record for record in distinct.values()}
    errors = {trial: record.last["valid_normalized_mse"] for trial, record in by_id.items()}
    front = pareto_front({trial: (errors[trial], cost[trial]) for trial in by_id})
    return [by_id[trial] for trial in sorted(front, key=errors.__getitem__)[:count]]


def recommend(
    valid_errors: Mapping[str, Sequence[float]],
    cost: Mapping[str, float],
    accurate_enough: float | None = None,
    unstable: Collection[str] = (),
) -> tuple[str, str]:
    """The cheapest stable model whose validation error is within one standard error of the best, or small enough.

    Source: the one-standard-error rule of Breiman et al., "Classification and Regression Trees" (1984), section 3.4.3,
    with the standard error over seeds.

    Args:
        valid_errors: Validation error of each seed, by model; a single one where no seed is drawn.
        cost: ms per frame, by model.
        accurate_enough: Error below which models count as equally accurate; None for no such limit.
        unstable: Models that failed a check of stability; they are chosen from only if there are no others.

    Returns:
        Name of the model, and the reason in words.
    """
    stable = {name: errors for name, errors in valid_errors.items() if name not in unstable}
    chosen, reason = _recommend(stable or valid_errors, cost, accurate_enough)
    if not stable:
        return chosen, f"{reason} No model passed every check of stability: see which failed before you use it."
    set_aside = len(valid_errors) - len(stable)
    return (
        chosen,
        f"{reason} It passed every check of stability{f', which {set_aside} others did not' * bool(set_aside)}.",
    )


def _recommend(
    valid_errors: Mapping[str, Sequence[float]], cost: Mapping[str, float], accurate_enough: float | None
) -> tuple[str, str]:
    means = {name: sum(values) / len(values) for name, values in valid_errors.items()}
    best = min(means, key=means.__getitem__)
    within = means[best] + _standard_error(valid_errors[best])
    limit = max(within, accurate_enough or 0.0)
    chosen = min((name for name in means if means[name] <= limit), key=cost.__getitem__)
    if chosen == best:
        cheaper = [name for name in means if cost[name] < cost[best]]
        why = "none cheaper is as accurate" if cheaper else "it is also the cheapest"
        return best, f"{best} has the smallest validation error ({means[best]:.3g}), and {why}."
    rule = "is within one standard error of the best" if limit == within else "is accurate enough for this study"
    return chosen, (
        f"{chosen} is the cheapest model ({cost[chosen]:.3g} ms per frame) whose validation error "
        f"({means[chosen]:.3g}) {rule} (limit {limit:.3g}; best is {best} with {means[best]:.3g})."
    )


def _standard_error(values: Sequence[float]) -> float:
    if len(values) == 1:
        return 0.0
    mean = sum(values) / len(values)
    variance = sum((value - mean) ** 2 for value in values) / (len(values) - 1)
    return (variance / len(values)) ** 0.5
