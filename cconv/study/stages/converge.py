"""The converge stage trains finalists with larger and larger budgets until their validation error stops falling.

A small budget shows how fast a network learns, not how accurate it can become. A model takes the next budget as long as
the last one lowered its mean validation error by more than the margin of non-inferiority. Every training starts from
new weights, because the learning-rate schedule is tied to the budget and cannot be continued.
"""

from collections.abc import Mapping, Sequence
from typing import Annotated, Literal

import numpy as np
from pydantic import Field, field_validator

from cconv.study.declared.stage import Stage, reads_of
from cconv.study.evidence.budget import still_falling
from cconv.study.records.found import BudgetPoint, Convergence, Found
from cconv.study.stages.finalists import Finalist, finalist_jobs, finalist_training, retrained_finalists
from cconv.study.stages.jobs import train_all
from cconv.study.stages.session import Session
from cconv.validation import Name, Whole


class ConvergeStage(Stage):
    """Train finalists with each of `budgets` (gradient updates, ascending) until more no longer lowers the error.

    `of` names the baseline or configurations in `include` of a stage of finalists; None means every trained finalist.
    """

    kind: Literal["converge"] = "converge"
    is_single = True
    counts_updates = True
    uses = ("finalists",)
    needs_records = True
    budgets: tuple[Annotated[Whole, Field(ge=1, le=10_000_000)], ...] = Field(min_length=1, max_length=20)
    of: tuple[Name, ...] | None = None

    @field_validator("budgets")
    @classmethod
    def _budgets_ascend(cls, budgets: tuple[int, ...]) -> tuple[int, ...]:
        if list(budgets) != sorted(set(budgets)):
            raise ValueError("budgets must ascend")
        return budgets

    @property
    def named_finalists(self) -> tuple[str, ...]:
        """Ids of the finalists that the stage asks for."""
        return self.of or ()

    def run(self, session: Session, name: str) -> Found:
        """Train the named finalists with one budget after another.

        Returns:
            The convergence of each model, and its longest training as a further finalist, whose id ends in its number
            of updates.
        """
        own = finalist_training(session.study).updates
        models = _named(_trained_finalists(session, name), self.of)
        points = {model: [point] for model in models if (point := _point(session, model, own))}
        going = list(points)
        for updates in self.budgets:
            ends = _train_with(session, name, {model: models[model] for model in going}, updates)
            for model, end in ends.items():
                points[model].append(end)
            going = [model for model in ends if still_falling(points[model], session.study.selection.margin)]
        return Found(
            finalists={each[-1].id: models[model] for model, each in points.items() if len(each) > 1},
            convergence={
                model: Convergence(points=each, still_falling=model in going) for model, each in points.items()
            },
        )


def _train_with(session: Session, stage: str, models: Mapping[str, dict], updates: int) -> dict[str, BudgetPoint]:
    """Train models with a budget; return the point of each model all of whose trainings finished."""
    study = session.study
    training = study.training.model_copy(update={"updates": updates})
    longer = [Finalist(id=f"{model}_after_{updates}", parameters=parameters) for model, parameters in models.items()]
    train_all(session, stage, finalist_jobs(longer, study.finalists.seeds, study.seeds.init + 1, session.run), training)
    points = {model: _point(session, f"{model}_after_{updates}", updates) for model in models}
    return {model: point for model, point in points.items() if point}


def _trained_finalists(session: Session, stage: str) -> dict[str, dict]:
    """Return the hyperparameters of the trained finalists by id, without closed forms."""
    retrainings = session.run.retrainings()
    found: dict[str, dict] = {}
    for name in reads_of(session.study.stages, stage):
        found |= session.run.result(name).finalists
    return {name: each for name, each in found.items() if not retrainings[name][0].is_closed_form}


def _named(models: Mapping[str, dict], names: Sequence[str] | None) -> dict[str, dict]:
    return {name: each for name, each in models.items() if names is None or name in names}


def _point(session: Session, finalist: str, updates: int) -> BudgetPoint | None:
    """Average the validation errors of a finalist's trainings with one budget; None if a training did not finish."""
    retrained, _ = retrained_finalists(session.run, [finalist], session.study.finalists.seeds)
    if not retrained:
        return None
    records, errors = retrained[0].records, retrained[0].valid_errors
    return BudgetPoint(
        id=finalist,
        updates=updates,
        valid_error=float(np.mean(errors)),
        by_seed=dict(zip([record.id for record in records], errors, strict=True)),
        train_seconds=float(np.mean([record.log[-1]["seconds"] for record in records])),
    )
