"""The stages that a study file declares, in the order in which they run, and which earlier ones each of them reads."""

from collections.abc import Mapping
from typing import Annotated, Literal

from pydantic import Field, field_validator

from cconv.errors import did_you_mean
from cconv.validation import StrictModel, Value

BASELINE = "baseline"  # id of the published network among the finalists


class _Stage(StrictModel):
    """`reads` names the stages whose records it uses; None means every earlier one of a kind that it can use."""

    reads: tuple[str, ...] | None = None


class ClosedFormStage(_Stage):
    """Least squares for the single linear layers of the space.

    At most `max_candidates` layers are fitted to `screening_frames` frames, ranges sampled at `values_per_range`
    places; the `count` best are fitted to all frames and become finalists.
    """

    kind: Literal["closed_form"]
    count: int = Field(3, ge=1)
    max_candidates: int = Field(200, ge=1)
    screening_frames: int = Field(4, ge=1)
    values_per_range: int = Field(3, ge=2)
    ridge: float = Field(1e-10, ge=0)


class InitializationStage(_Stage):
    """Trainings that nothing stops: the baseline with `seeds` initial weights, `configurations` of the space with one.

    They tell the luck of initial weights from the choice of a configuration, and serve as the audit of the rungs.
    """

    kind: Literal["initialization"]
    seeds: int = Field(5, ge=2)
    configurations: int = Field(16, ge=2)


class BaselineStage(_Stage):
    """The published network, trained to the full budget as every trial could be."""

    kind: Literal["baseline"]


class RandomStage(_Stage):
    """Random search with ASHA, in the study's space or in the one that the stage `space` refined."""

    kind: Literal["random"]
    trials: int = Field(16, ge=1)
    space: str | None = None


class AdaptiveStage(_Stage):
    """Tree-structured Parzen estimator with ASHA for error and cost, which learns from the stages that it reads."""

    kind: Literal["adaptive"]
    trials: int = Field(16, ge=1)
    space: str | None = None


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
    count: int = Field(3, ge=1)
    include: dict[str, dict[str, Value]] = {}


class ImportanceStage(_Stage):
    """Importance of the hyperparameters at each rung of the random searches that it reads, with a noise floor."""

    kind: Literal["importance"]


class AblationStage(_Stage):
    """Retrainings between the baseline and the best finalist, and of the best finalist without each of its parts."""

    kind: Literal["ablation"]
    seeds: int = Field(1, ge=1)


class ConvergeStage(_Stage):
    """Trains finalists with each of `budgets` (gradient updates, ascending) until more no longer lowers the error.

    `of` names the baseline or configurations that a stage of finalists includes; None means every trained finalist.
    """

    kind: Literal["converge"]
    budgets: tuple[Annotated[int, Field(ge=1, le=10_000_000)], ...] = Field(min_length=1, max_length=20)
    of: tuple[str, ...] | None = None

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
