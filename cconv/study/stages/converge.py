"""The converge stage: finalists trained again with larger and larger budgets until the validation error stops falling.

A small budget says what a network reaches quickly, not what it can reach. A model takes the next budget of the stage as
long as the last one lowered its mean validation error by more than the margin of non-inferiority. Every training starts
afresh, as a learning rate that fades with the budget cannot be continued.
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

    `of` names the baseline or configurations that a stage of finalists includes; None means every trained finalist.
    """

    kind: Literal["converge"] = "converge"
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
        """Train the finalists that the stage names with its budgets, one after another.

        Returns:
            The convergence of each model; and as finalists the longest training of each, by an id that ends in its
            updates.
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
    """Train models with a budget; returns the point of each whose trainings all finished."""
    study = session.study
    training = study.training.model_copy(update={"updates": updates})
    longer = [Finalist(id=f"{model}_after_{updates}", parameters=parameters) for model, parameters in models.items()]
    train_all(session, stage, finalist_jobs(longer, study.finalists.seeds, study.seeds.init + 1, session.run), training)
    points = {model: _point(session, f"{model}_after_{updates}", updates) for model in models}
    return {model: point for model, point in points.items() if point}


def _trained_finalists(session: Session, stage: str) -> dict[str, dict]:
    """Hyperparameters of the finalists that were trained, and not fitted, by id."""
    retrainings = session.run.retrainings()
    found: dict[str, dict] = {}
    for name in reads_of(session.study.stages, stage):
        found |= session.run.result(name).finalists
    return {name: each for name, each in found.items() if not retrainings[name][0].is_closed_form}


def _named(models: Mapping[str, dict], names: Sequence[str] | None) -> dict[str, dict]:
    return {name: each for name, each in models.items() if names is None or name in names}


def _point(session: Session, finalist: str, updates: int) -> BudgetPoint | None:
    """Mean validation error of a finalist's trainings with one budget; None if not all of them finished."""
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
