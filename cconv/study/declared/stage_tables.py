"""The stages that a study file declares, in the order in which they run, and which earlier ones each of them reads."""

import re
from collections.abc import Mapping
from typing import Annotated, Literal

from pydantic import Field, field_validator

from cconv.errors import did_you_mean
from cconv.validation import Name, Real, StrictModel, Value, Whole

MOST_TRIALS = 100_000  # of a search
Ridge = Annotated[Real, Field(ge=0, le=1e6)]  # weight of the squared coefficients, in mean squares of a term
Trials = Annotated[Whole, Field(ge=1, le=MOST_TRIALS)]

BASELINE = "baseline"  # id of the published network among the finalists


class _Stage(StrictModel):
    """`reads` names the stages whose records it uses; None means every earlier one of a kind that it can use."""

    reads: tuple[Name, ...] | None = None


class ClosedFormStage(_Stage):
    """Least squares for the single linear layers of the space.

    At most `max_candidates` layers are fitted to `screening_frames` frames, ranges sampled at `values_per_range`
    places; the `count` best are fitted to all frames and become finalists.
    """

    kind: Literal["closed_form"]
    count: Whole = Field(3, ge=1, le=1000)
    max_candidates: Whole = Field(200, ge=1, le=10_000)
    screening_frames: Whole = Field(4, ge=1, le=10_000)
    values_per_range: Whole = Field(3, ge=2, le=100)
    ridge: Ridge = 1e-10


class InitializationStage(_Stage):
    """Trainings that nothing stops: the baseline with `seeds` initial weights, `configurations` of the space with one.

    They tell the luck of initial weights from the choice of a configuration, and serve as the audit of the rungs.
    """

    kind: Literal["initialization"]
    seeds: Whole = Field(5, ge=2, le=1000)
    configurations: Whole = Field(16, ge=2, le=MOST_TRIALS)


class BaselineStage(_Stage):
    """The published network, trained to the full budget as every trial could be."""

    kind: Literal["baseline"]


class RandomStage(_Stage):
    """Random search with ASHA, in the study's space or in the one that the stage `space` refined."""

    kind: Literal["random"]
    trials: Trials = 16
    space: Name | None = None


class AdaptiveStage(_Stage):
    """Tree-structured Parzen estimator with ASHA for error and cost, which learns from the stages that it reads."""

    kind: Literal["adaptive"]
    trials: Trials = 16
    space: Name | None = None


class ReferenceStage(_Stage):
    """The budget of the searches that it reads spent otherwise: each trial a little, the best of them to the end."""

    kind: Literal["reference"]


class RefineStage(_Stage):
    """Narrows the space from the records that it reads, with a reason for each parameter."""

    kind: Literal["refine"]


class FinalistsStage(_Stage):
    """The `count` best trained configurations, the best closed forms and the baseline, retrained with fresh seeds.

    `include` names further configurations, e.g. a published one, by the id that they get.
    """

    kind: Literal["finalists"]
    count: Whole = Field(3, ge=1, le=1000)
    include: dict[Name, dict[str, Value]] = Field({}, max_length=100)


class ImportanceStage(_Stage):
    """Importance of the hyperparameters at each rung of the random searches that it reads, with a noise floor."""

    kind: Literal["importance"]


class AblationStage(_Stage):
    """Retrainings between the baseline and the best finalist, and of the best finalist without each of its parts."""

    kind: Literal["ablation"]
    seeds: Whole = Field(1, ge=1, le=1000)


class ConvergeStage(_Stage):
    """Trains finalists with each of `budgets` (gradient updates, ascending) until more no longer lowers the error.

    `of` names the baseline or configurations that a stage of finalists includes; None means every trained finalist.
    """

    kind: Literal["converge"]
    budgets: tuple[Annotated[Whole, Field(ge=1, le=10_000_000)], ...] = Field(min_length=1, max_length=20)
    of: tuple[Name, ...] | None = None

    @field_validator("budgets")
    @classmethod
    def _budgets_ascend(cls, budgets: tuple[int, ...]) -> tuple[int, ...]:
        if list(budgets) != sorted(set(budgets)):
            raise ValueError("budgets must ascend")
        return budgets


class SelectStage(_Stage):
    """Tests, times and stresses the finalists and recommends one."""

    kind: Literal["select"]


Stage = Annotated[
    ClosedFormStage
    | InitializationStage
    | BaselineStage
    | RandomStage
    | AdaptiveStage
    | ReferenceStage
    | RefineStage
    | ImportanceStage
    | FinalistsStage
    | AblationStage
    | ConvergeStage
    | SelectStage,
    Field(discriminator="kind"),
]

# Kinds of stages that a stage of each kind can use.
USES = {
    "closed_form": (),
    "initialization": (),
    "baseline": (),
    "random": (),
    "reference": ("random", "adaptive"),
    "refine": ("baseline", "initialization", "random"),
    "importance": ("random",),
    "adaptive": ("baseline", "initialization", "random"),
    "finalists": ("closed_form", "random", "adaptive"),
    "ablation": ("initialization", "random", "finalists"),
    "converge": ("finalists",),
    "select": ("finalists", "converge"),
}
NEEDS = {
    "reference",
    "refine",
    "importance",
    "finalists",
    "ablation",
    "converge",
    "select",
}  # idle without a stage to read

RESERVED = {"data", "train"}  # records say so where no stage of a study is meant
BASELINES = {"baseline"}  # ids of finalists that no study file gives


def default_stages() -> dict[str, StrictModel]:
    """The shortest study that answers: closed forms, a random search, finalists, selection."""
    return {
        "closed_form": ClosedFormStage(kind="closed_form"),
        "random": RandomStage(kind="random"),
        "finalists": FinalistsStage(kind="finalists"),
        "select": SelectStage(kind="select"),
    }


def reads_of(stages: Mapping[str, StrictModel], name: str) -> list[str]:
    """The stages whose records a stage reads, in their own order."""
    stage, names = stages[name], list(stages)
    if stage.reads is not None:
        return [other for other in names if other in stage.reads]
    return [other for other in names[: names.index(name)] if stages[other].kind in USES[stage.kind]]


def readers_of(stages: Mapping[str, StrictModel], name: str) -> set[str]:
    """The stages that a stage's records reach, directly or through others."""
    reached = {name}
    for other, stage in stages.items():
        if reached & {*reads_of(stages, other), getattr(stage, "space", None)}:
            reached.add(other)
    return reached - {name}


def check_names(stages: Mapping[str, StrictModel]) -> None:
    """Check that no name of a stage or of a finalist can be taken for another's, in the records or by a reader.

    Raises:
        ValueError: With the name and what it could be taken for.
    """
    for name, stage in stages.items():
        if name in RESERVED or (name in USES and name != stage.kind):
            raise ValueError(f"stage `{name}` must have another name: that one is kept for what it is called after")
        like = [other for other in stages if other != name and name.casefold() == other.casefold()]
        like += [other for other in stages if re.fullmatch(rf"{re.escape(other)}_\d+", name)]
        if like:
            raise ValueError(f"stage `{name}` could be taken for stage `{like[0]}` or one of its trials; rename it")
    known: dict[str, dict] = {}
    for finalist, parameters in included(stages):
        like = [stage for stage in stages if finalist.startswith(f"{stage}_")]
        if like:
            raise ValueError(f"finalist `{finalist}` could be taken for a trial of stage `{like[0]}`; rename it")
        if finalist in BASELINES or known.setdefault(finalist, parameters) != parameters:
            raise ValueError(f"finalist `{finalist}` must have another name: that one is another configuration's")


def included(stages: Mapping[str, StrictModel]) -> list[tuple[str, dict[str, Value]]]:
    """Ids and hyperparameters of the configurations that the stages include by name."""
    return [each for stage in stages.values() for each in getattr(stage, "include", {}).items()]


def check_order(stages: Mapping[str, StrictModel]) -> None:
    """Check that every stage reads earlier stages that it can use.

    Raises:
        ValueError: With the stage, what is wrong, and the nearest name.
    """
    names = list(stages)
    for place, name in enumerate(names):
        stage, earlier = stages[name], names[:place]
        space = getattr(stage, "space", None)
        for other in [*(stage.reads or ()), *([space] if space else [])]:
            if other not in earlier:
                hint = did_you_mean(other, earlier)
                raise ValueError(f"stage `{name}` names `{other}`, which is no stage before it.{hint}")
        for other in stage.reads or ():
            if stages[other].kind not in USES[stage.kind]:
                uses = ", ".join(USES[stage.kind]) or "none"
                raise ValueError(f"stage `{name}` cannot use the records of `{other}`; kinds that it can use: {uses}")
        if space and stages[space].kind != "refine":
            raise ValueError(f"stage `{name}` takes its space from `{space}`, which is no stage of kind refine")
        _check_named_finalists(stages, name)
        if stage.kind in NEEDS and not reads_of(stages, name):
            raise ValueError(f"stage `{name}` has nothing to read; put one of {', '.join(USES[stage.kind])} before it")


def _check_named_finalists(stages: Mapping[str, StrictModel], name: str) -> None:
    """Check that a stage which names finalists names some that are sure to be there."""
    included = [each for other in reads_of(stages, name) for each in getattr(stages[other], "include", ())]
    for finalist in getattr(stages[name], "of", None) or ():
        if finalist not in (BASELINE, *included):
            known = ", ".join((BASELINE, *included))
            raise ValueError(f"stage `{name}` names the finalist `{finalist}`; it can name {known}")
