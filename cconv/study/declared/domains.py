"""Domains of hyperparameters and the conditions under which they are active, whatever they are hyperparameters of."""

from collections.abc import Mapping
from graphlib import CycleError, TopologicalSorter
from typing import Annotated, Literal, Self

from pydantic import Field, ValidationError, field_validator, model_validator
from pydantic_core import InitErrorDetails, PydanticCustomError

from cconv.errors import did_you_mean, shown
from cconv.study.declared.paths import is_table_of_tables, paths_of_tables
from cconv.validation import LARGEST_VALUE, Real, StrictModel, Text, Value, Whole

MOST_VALUES = 100  # of a choice, or of a condition
_Whole = Annotated[Whole, Field(ge=-(10**9), le=10**9)]
_Real = Annotated[Real, Field(ge=-LARGEST_VALUE, le=LARGEST_VALUE)]
_Values = Annotated[list[Value], Field(min_length=1, max_length=MOST_VALUES)]


def _at(where: tuple[str, ...], problem: str, came: object) -> ValidationError:
    """A validation error at a key of the space."""
    kind = PydanticCustomError("condition", "{problem}", {"problem": problem})
    return ValidationError.from_exception_data("SearchSpace", [InitErrorDetails(type=kind, loc=where, input=came)])


class _Parameter(StrictModel):
    """What all domains share: the reason, and `when`, the values of other parameters that make this one active."""

    reason: Text
    when: dict[str, _Values] = Field({}, max_length=MOST_VALUES)

    @field_validator("when", mode="before")
    @classmethod
    def _conditions_by_path(cls, when: object) -> object:
        return paths_of_tables(when)


class Choice(_Parameter):
    """One of a few values, without order."""

    type: Literal["choice"]
    values: _Values
    baseline: Value

    @model_validator(mode="after")
    def _baseline_is_listed(self) -> "Choice":
        if not self.holds(self.baseline):
            raise ValueError(f"the baseline {self.baseline!r} must be one of the values {shown(self.values)}")
        return self

    @property
    def extremes(self) -> list[Value]:
        """Values that must all be possible."""
        return self.values

    def holds(self, value: Value) -> bool:
        """Whether a value is in the domain; true is no 1."""
        return any(value == listed and isinstance(value, bool) == isinstance(listed, bool) for listed in self.values)


class _Range(_Parameter):
    """What both kinds of numbers share; true is no number."""

    scale: Literal["linear", "log"] = "linear"
    type: Literal["int", "float"]
    range: tuple[_Real, _Real]
    baseline: _Real

    @model_validator(mode="after")
    def _baseline_is_inside(self) -> Self:
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

    def _spans(self, value: float) -> bool:
        return not isinstance(value, bool) and self.range[0] <= value <= self.range[1]


class IntRange(_Range):
    """A whole number, both ends included."""

    type: Literal["int"]
    range: tuple[_Whole, _Whole]
    baseline: _Whole

    def holds(self, value: Value) -> bool:
        """Whether a value is in the domain."""
        return isinstance(value, int) and self._spans(value)


class FloatRange(_Range):
    """A real number."""

    type: Literal["float"]

    def holds(self, value: Value) -> bool:
        """Whether a value is in the domain."""
        return isinstance(value, int | float) and self._spans(value)


Parameter = Annotated[Choice | IntRange | FloatRange, Field(discriminator="type")]


class SearchSpace(StrictModel):
    """A named set of hyperparameters and their domains.

    A parameter is active where every condition of its `when` holds: the named parameter is active and has one of the
    listed values. A configuration is an assignment of the active parameters only. No trial's prediction may take more
    than `max_flops_per_particle` multiplications and additions a particle, or move more than `max_bytes_per_particle`.
    """

    name: Annotated[Text, Field(min_length=1, max_length=200)]
    description: Text
    max_flops_per_particle: Real | None = Field(None, gt=0, le=1e18)
    max_bytes_per_particle: Real | None = Field(None, gt=0, le=1e18)
    parameters: dict[str, Parameter] = Field(min_length=1, max_length=MOST_VALUES)

    @field_validator("parameters", mode="before")
    @classmethod
    def _parameters_by_path(cls, parameters: object) -> object:
        return paths_of_tables(parameters, is_table_of_tables)

    @model_validator(mode="after")
    def _conditions_can_hold(self) -> "SearchSpace":
        for name, parameter in self.parameters.items():
            for parent, values in parameter.when.items():
                if problem := self._problem_of(parent, values):
                    raise _at(("parameters", name, "when", parent), problem, {})
        try:
            self.parents_first  # noqa: B018
        except CycleError as error:
            circle = error.args[1]
            where = ("parameters", circle[0], "when")
            raise _at(where, f"closes a circle of conditions: {' -> '.join(circle)}", {}) from error
        return self

    def _problem_of(self, parent: str, values: list[Value]) -> str:
        """What is wrong with a condition, or ""."""
        if parent not in self.parameters:
            known = f"{did_you_mean(parent, self.parameters)} Known: {', '.join(self.parameters)}"
            return f"names no parameter of the space.{known}"
        domain = self.parameters[parent]
        if isinstance(domain, FloatRange):
            return f"must be on a choice or a whole number, and {parent!r} is a real number"
        outside = [value for value in values if not domain.holds(value)]
        return f"lists {outside[0]!r}, which is not in the domain of {parent!r}" if outside else ""

    @property
    def caps(self) -> dict[str, float]:
        """Caps on cost that the space has, by the name of what they cap."""
        caps = {
            "flops_per_particle": self.max_flops_per_particle,
            "bytes_per_particle": self.max_bytes_per_particle,
        }
        return {name: cap for name, cap in caps.items() if cap is not None}

    @property
    def parents_first(self) -> list[str]:
        """Names of the parameters, each after those that its conditions name."""
        return list(TopologicalSorter({name: list(each.when) for name, each in self.parameters.items()}).static_order())

    @property
    def baseline(self) -> dict[str, Value]:
        """Baseline value of every parameter that is active in the baseline."""
        return self.active({name: parameter.baseline for name, parameter in self.parameters.items()})

    def active(self, values: Mapping[str, Value]) -> dict[str, Value]:
        """The active parameters of an assignment, in the order of the space.

        Args:
            values: Value of each parameter; those of inactive ones may be missing.
        """
        kept: set[str] = set()
        for name in self.parents_first:
            if self.is_active(name, {parent: values[parent] for parent in kept}):
                kept.add(name)
        return {name: values[name] for name in self.parameters if name in kept}

    def making_active(self, name: str) -> dict[str, Value]:
        """Values of other parameters with which a parameter is active: the first that each condition lists."""
        values: dict[str, Value] = {}
        for parent, listed in self.parameters[name].when.items():
            values |= self.making_active(parent) | {parent: listed[0]}
        return values

    def is_active(self, name: str, active: Mapping[str, Value]) -> bool:
        """Whether a parameter's conditions hold, given the active parameters among those that they name."""
        when = self.parameters[name].when
        return all(parent in active and active[parent] in listed for parent, listed in when.items())

    def holds(self, parameters: Mapping[str, Value]) -> bool:
        """Whether `parameters` are a whole configuration: exactly the active parameters, each in its domain."""
        known = all(name in self.parameters for name in parameters)
        whole = all(self.is_active(name, parameters) == (name in parameters) for name in self.parameters)
        return known and whole and all(self.parameters[name].holds(value) for name, value in parameters.items())


def narrowed(space: SearchSpace, domains: Mapping[str, Parameter]) -> SearchSpace:
    """The space with other domains for some parameters.

    Conditions on values that are gone lose them; a parameter that can no longer become active is left out.
    """
    parameters = {**space.parameters, **domains}
    kept: dict[str, Parameter] = {}
    for name in space.parents_first:
        when = {
            parent: [value for value in values if parent in kept and kept[parent].holds(value)]
            for parent, values in parameters[name].when.items()
        }
        if all(when.values()):
            kept[name] = parameters[name].model_copy(update={"when": when})
    return space.model_copy(update={"parameters": {name: kept[name] for name in parameters if name in kept}})


def fixed(space: SearchSpace, name: str) -> SearchSpace:
    """The space with one parameter held at its baseline, e.g. whether walls are seen in a scene without walls."""
    if name not in space.parameters:
        return space
    parameter = space.parameters[name]
    only = Choice(
        type="choice",
        values=[parameter.baseline],
        baseline=parameter.baseline,
        reason=parameter.reason,
        when=parameter.when,
    )
    return narrowed(space, {name: only})
