"""Refinement narrows a search space by the records of earlier stages, and gives the evidence for every change.

A value of a choice, or a part of a range beyond the best trials, is removed only if at most a tenth of the best trials
use it and so few are significant: if the value had no influence, the number of the best trials that use it would follow
a hypergeometric distribution. The values of the baseline and of the best trial are always kept.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from operator import eq, itemgetter
from pathlib import Path
from typing import Generic, TypeVar, cast

import tomli_w
from scipy.stats import hypergeom

from cconv.files import write_text
from cconv.study.declared.domains import Choice, FloatRange, IntRange, Parameter, SearchSpace, Value, narrowed
from cconv.study.records.trials import TrialRecord, identity

MIN_TRIALS = 20
TOP_SHARE = 0.25
SPARED_SHARE = 0.1  # of the best trials; as many may use a value that is removed
SIGNIFICANCE = 0.01  # probability of removing a value that has no influence
MARGIN = 0.1  # of the range, beyond the best trials


Drawn = TypeVar("Drawn", bound=Value)


@dataclass(frozen=True)
class _Evidence(Generic[Drawn]):
    """Values of a parameter in the trials in which it is active.

    Attributes:
        values: Value of each trial.
        top: Value of each of the best trials, the best one first.
        where: The budget at which they were compared, in words.
    """

    values: list[Drawn]
    top: list[Drawn]
    where: str

    @property
    def spared(self) -> int:
        """Number of the best trials that may use a value that is removed."""
        return int(SPARED_SHARE * len(self.top))

    def is_unwanted(self, condition: Callable[[Drawn], bool]) -> bool:
        """Tell whether significantly few of the best trials have a value that meets a condition."""
        drawn, used = (sum(map(condition, values)) for values in (self.values, self.top))
        chance = hypergeom.cdf(used, len(self.values), drawn, len(self.top))
        return used <= self.spared and bool(chance <= SIGNIFICANCE)

    def use_of(self, value: Drawn) -> str:
        """Say how often a value was drawn."""
        return f"{value!r} ({self.top.count(value)} of the best, {self.values.count(value)} of all)"

    def __str__(self) -> str:
        return f"the best {len(self.top)} of {len(self.values)} trials {self.where}"


def refine(space: SearchSpace, records: Sequence[TrialRecord], full_updates: int) -> tuple[SearchSpace, dict[str, str]]:
    """Remove the values that the best trials do not use from a space, and give a reason for each parameter.

    The best are a quarter of all trials, compared at the largest budget that so many reached. A parameter stays as it
    is with fewer than `MIN_TRIALS` trials. For a conditional parameter only the trials in which it is active count.
    Several trainings of one configuration count once.

    Args:
        space: The space that the trials were drawn from.
        records: Trials of earlier stages; closed forms, failed and interrupted trials are left out.
        full_updates: Budget of a trial that was never stopped.

    Returns:
        The narrowed space, and the decision about each parameter of the old one, in words.
    """
    trained = _distinct([record for record in records if _counts(record)])
    domains, reasons = {}, {}
    for name, parameter in space.parameters.items():
        domains[name], reasons[name] = _refined(name, parameter, trained, full_updates)
    refined = narrowed(space, domains)
    for name in space.parameters.keys() - refined.parameters.keys():
        reasons[name] = f"left out: no remaining value of {' and '.join(space.parameters[name].when)} makes it active"
    parameters = {
        name: parameter.model_copy(
            update={"reason": f"{parameter.reason} {reasons[name][0].upper()}{reasons[name][1:]}."}
        )
        for name, parameter in refined.parameters.items()
    }
    update = {
        "name": f"{space.name}_refined",
        "description": f"{space.description} Narrowed by the records of {len(trained)} trials.",
        "parameters": parameters,
    }
    return refined.model_copy(update=update), {name: reasons[name] for name in space.parameters}


def write_space(space: SearchSpace, path: Path | str) -> None:
    """Write a space as a TOML file that `load_space` reads back."""
    write_text(Path(path), tomli_w.dumps(space.model_dump(mode="json", exclude_defaults=True)))


def _counts(record: TrialRecord) -> bool:
    return not record.is_closed_form and record.outcome not in ("failed", "interrupted")


def _distinct(records: Sequence[TrialRecord]) -> list[TrialRecord]:
    """Keep the first training of each configuration."""
    first: dict[str, TrialRecord] = {}
    for record in records:
        first.setdefault(identity(record.parameters), record)
    return list(first.values())


def _refined(
    name: str, parameter: Parameter, records: Sequence[TrialRecord], full_updates: int
) -> tuple[Parameter, str]:
    active = [record for record in records if name in record.parameters and parameter.holds(record.parameters[name])]
    evidence = _evidence(name, active, full_updates)
    if evidence is None:
        return parameter, f"kept: too few trials, {len(active)} of the {MIN_TRIALS} that are needed"
    if isinstance(parameter, Choice):
        return _narrow_choice(parameter, evidence)
    return _narrow_range(parameter, cast(_Evidence[float], evidence))  # a range has numbers only


def _evidence(name: str, records: Sequence[TrialRecord], full_updates: int) -> _Evidence[Value] | None:
    """Compare trials at the largest budget that a quarter of them reached; None if there are too few trials."""
    values = [record.parameters[name] for record in records]
    trials = list(zip(map(_errors_by_updates, records), values, strict=True))
    count = math.ceil(TOP_SHARE * max(len(trials), MIN_TRIALS))
    for updates in sorted({updates for errors, _ in trials for updates in errors}, reverse=True):
        reached = sorted(((errors[updates], value) for errors, value in trials if updates in errors), key=itemgetter(0))
        if len(trials) >= MIN_TRIALS and len(reached) >= count:
            where = f"({len(reached)} compared at {updates} of {full_updates} updates)"
            return _Evidence(values, [value for _, value in reached[:count]], where)
    return None


def _errors_by_updates(record: TrialRecord) -> Mapping[int, float]:
    return {entry["updates"]: entry["valid_error"] for entry in record.log if entry["valid_error"] is not None}


def _narrow_choice(parameter: Choice, evidence: _Evidence[Value]) -> tuple[Choice, str]:
    """Return a choice without its unwanted values, and the reason."""
    unwanted = [value for value in parameter.values if evidence.is_unwanted(partial(eq, value))]
    kept = [
        value for value in parameter.values if value not in unwanted or value in _held(parameter.baseline, evidence)
    ]
    listed = ", ".join(map(evidence.use_of, unwanted))
    if not unwanted:
        return parameter, f"kept: no clear preference among {evidence}"
    if len(kept) == len(parameter.values):
        return parameter, f"kept, as the baseline or the best trial has it: {listed} among {evidence}"
    return parameter.model_copy(update={"values": kept}), f"narrowed to {kept}: {evidence} hardly use {listed}"


def _narrow_range(parameter: IntRange | FloatRange, evidence: _Evidence[float]) -> tuple[IntRange | FloatRange, str]:
    """Return a range without its unwanted ends, and the reason."""
    ordered = sorted(evidence.top)
    lowest, highest = ordered[evidence.spared], ordered[-1 - evidence.spared]
    low, high = _with_margin(parameter, lowest, highest)
    held = _held(parameter.baseline, evidence)
    ends = (
        min(low, *held) if evidence.is_unwanted(lambda value: value < lowest) else parameter.range[0],
        max(high, *held) if evidence.is_unwanted(lambda value: value > highest) else parameter.range[1],
    )
    inside = sum(lowest <= value <= highest for value in evidence.values)
    facts = (
        f"{len(ordered) - 2 * evidence.spared} of {evidence} lie in [{lowest:.3g}, {highest:.3g}], "
        f"as {inside} of all trials do"
    )
    if ends == parameter.range:
        return parameter, f"kept: no clear preference, {facts}"
    return (
        parameter.model_copy(update={"range": ends}),
        f"narrowed to [{ends[0]:.3g}, {ends[1]:.3g}], which holds the baseline, the best trial and a margin: {facts}",
    )


def _held(baseline: Drawn, evidence: _Evidence[Drawn]) -> tuple[Drawn, Drawn]:
    """Return the values that are always kept: those of the baseline and of the best trial."""
    return baseline, evidence.top[0]


def _with_margin(parameter: IntRange | FloatRange, lowest: float, highest: float) -> tuple[float, float]:
    """Widen an interval by a margin on the parameter's scale; round it out to whole numbers, or to three digits."""
    log = parameter.scale == "log"
    ends = [math.log(end) if log else float(end) for end in (*parameter.range, lowest, highest)]
    margin = MARGIN * (ends[1] - ends[0])
    low, high = (math.exp(end) if log else end for end in (ends[2] - margin, ends[3] + margin))
    low, high = (math.floor(low), math.ceil(high)) if parameter.type == "int" else (_rounded(low), _rounded(high))
    return max(low, parameter.range[0]), min(high, parameter.range[1])


def _rounded(value: float) -> float:
    return float(f"{value:.3g}")
