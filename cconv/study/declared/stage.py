"""What a stage of a study is: settings that every kind shares, the order of stages, which earlier ones each reads.

The kinds themselves stand in `stages`, one file each; nothing here names one of them.
"""

import re
from abc import ABC, abstractmethod
from collections.abc import Collection, Mapping
from typing import Annotated, Any, ClassVar

from pydantic import Field

from cconv.errors import did_you_mean
from cconv.validation import Name, Real, StrictModel, Value, Whole

MOST_TRIALS = 100_000  # of a search
Ridge = Annotated[Real, Field(ge=0, le=1e6)]  # weight of the squared coefficients, in mean squares of a term
Trials = Annotated[Whole, Field(ge=1, le=MOST_TRIALS)]

BASELINE = "baseline"  # id of the published network among the finalists
RESERVED = {"data", "train"}  # records say so where no stage of a study is meant


class Stage(StrictModel, ABC):
    """One step of a study: its table in the study file, and what it does when its turn comes.

    A subclass declares `kind` as a `Literal` of its own kind, which is also its default.

    Attributes:
        uses: Kinds of stages whose records it can read.
        needs_records: Whether it can do nothing without a stage to read.
        space_kinds: Kinds of stages whose narrowed space it can search.
        only_for_steps: Whether it makes sense for tasks of steps alone.
        counts_updates: Whether it compares trainings after equal numbers of updates, whatever time they take.
        fits_squares: Whether it fits models by least squares, with the study's loss.
        is_single: Whether a study has at most one stage of the kind, because the summary has one place for its result.
        reads: Names of the stages whose records it uses; None means every earlier one of a kind that it can use.
        kind: Its kind, by which the study file chooses the class.
    """

    uses: ClassVar[tuple[str, ...]] = ()
    needs_records: ClassVar[bool] = False
    space_kinds: ClassVar[tuple[str, ...]] = ()
    only_for_steps: ClassVar[bool] = False
    counts_updates: ClassVar[bool] = False
    fits_squares: ClassVar[bool] = False
    is_single: ClassVar[bool] = False
    reads: tuple[Name, ...] | None = None
    kind: str

    @property
    def space_from(self) -> str | None:
        """The stage whose narrowed space this one searches; None means the study's own space."""
        return None

    @property
    def included(self) -> Mapping[str, dict[str, Value]]:
        """Hyperparameters of the configurations that the stage makes finalists, by the id that they get."""
        return {}

    @property
    def named_finalists(self) -> tuple[str, ...]:
        """Ids of the finalists that the stage asks for."""
        return ()

    @abstractmethod
    def run(self, session: Any, name: str) -> StrictModel:
        """Do the work of the stage and return what it found, a `Found` of the package `records`.

        A run that was interrupted calls it again: what is recorded already must not be computed twice.

        Args:
            session: What the stages of the run share, a `Session` of the package `stages`.
            name: Name of the stage in the study file.
        """


def kind_of(stage: type[Stage]) -> str:
    """The kind by which a study file asks for a class of stages."""
    return stage.model_fields["kind"].default


def reads_of(stages: Mapping[str, Stage], name: str) -> list[str]:
    """The stages whose records a stage reads, in their own order."""
    stage, names = stages[name], list(stages)
    if stage.reads is not None:
        return [other for other in names if other in stage.reads]
    return [other for other in names[: names.index(name)] if stages[other].kind in stage.uses]


def readers_of(stages: Mapping[str, Stage], name: str) -> set[str]:
    """The stages that a stage's records reach, directly or through others."""
    reached = {name}
    for other, stage in stages.items():
        if reached & {*reads_of(stages, other), stage.space_from}:
            reached.add(other)
    return reached - {name}


def included(stages: Mapping[str, Stage]) -> list[tuple[str, dict[str, Value]]]:
    """Ids and hyperparameters of the configurations that the stages include by name."""
    return [each for stage in stages.values() for each in stage.included.items()]


def check_names(stages: Mapping[str, Stage], kinds: Collection[str]) -> None:
    """Check that no name of a stage or of a finalist can be taken for another's, in the records or by a reader.

    Args:
        stages: The stages by name.
        kinds: All kinds of stages that a study file can ask for.

    Raises:
        ValueError: With the name and what it could be taken for.
    """
    for name, stage in stages.items():
        if name in RESERVED or (name in kinds and name != stage.kind):
            raise ValueError(f"stage `{name}` must have another name: that one is kept for what it is called after")
        like = [other for other in stages if other != name and name.casefold() == other.casefold()]
        like += [other for other in stages if re.fullmatch(rf"{re.escape(other)}_\d+", name)]
        if like:
            raise ValueError(f"stage `{name}` could be taken for stage `{like[0]}` or one of its trials; rename it")
    _check_finalist_names(stages)


def _check_finalist_names(stages: Mapping[str, Stage]) -> None:
    known: dict[str, dict] = {}
    for finalist, parameters in included(stages):
        like = [stage for stage in stages if finalist.startswith(f"{stage}_")]
        if like:
            raise ValueError(f"finalist `{finalist}` could be taken for a trial of stage `{like[0]}`; rename it")
        if finalist == BASELINE or known.setdefault(finalist, parameters) != parameters:
            raise ValueError(f"finalist `{finalist}` must have another name: that one is another configuration's")


def check_order(stages: Mapping[str, Stage]) -> None:
    """Check that every stage reads earlier stages that it can use, and that no result would replace another's.

    Raises:
        ValueError: With the stage, what is wrong, and the nearest name.
    """
    for name in stages:
        _check_no_other_is_of_a_single_kind(stages, name)
        _check_named_stages_are_earlier(stages, name)
        _check_named_stages_are_usable(stages, name)
        _check_named_finalists(stages, name)
        stage = stages[name]
        if stage.needs_records and not reads_of(stages, name):
            raise ValueError(f"stage `{name}` has nothing to read; put one of {', '.join(stage.uses)} before it")


def _check_no_other_is_of_a_single_kind(stages: Mapping[str, Stage], name: str) -> None:
    kind = stages[name].kind
    first = next(other for other, stage in stages.items() if stage.kind == kind)
    if stages[name].is_single and first != name:
        raise ValueError(
            f"stages `{first}` and `{name}` are both of kind {kind}, and the summary holds the result of one; remove "
            "one of them, or give it a study of its own"
        )


def _check_named_stages_are_earlier(stages: Mapping[str, Stage], name: str) -> None:
    names, stage = list(stages), stages[name]
    earlier = names[: names.index(name)]
    for other in [*(stage.reads or ()), *([stage.space_from] if stage.space_from else [])]:
        if other not in earlier:
            hint = did_you_mean(other, earlier)
            raise ValueError(f"stage `{name}` names `{other}`, which is no stage before it.{hint}")


def _check_named_stages_are_usable(stages: Mapping[str, Stage], name: str) -> None:
    stage = stages[name]
    for other in stage.reads or ():
        if stages[other].kind not in stage.uses:
            uses = ", ".join(stage.uses) or "none"
            raise ValueError(f"stage `{name}` cannot use the records of `{other}`; kinds that it can use: {uses}")
    space = stage.space_from
    if space and stages[space].kind not in stage.space_kinds:
        kinds = " or ".join(stage.space_kinds)
        raise ValueError(f"stage `{name}` takes its space from `{space}`, which is no stage of kind {kinds}")


def _check_named_finalists(stages: Mapping[str, Stage], name: str) -> None:
    """Check that a stage which names finalists names some that are sure to be there."""
    sure = (BASELINE, *(each for other in reads_of(stages, name) for each in stages[other].included))
    for finalist in stages[name].named_finalists:
        if finalist not in sure:
            raise ValueError(f"stage `{name}` names the finalist `{finalist}`; it can name {', '.join(sure)}")
