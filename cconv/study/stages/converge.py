"""The converge stage: finalists trained again with larger and larger budgets until the validation error stops falling.

A small budget says what a network reaches quickly, not what it can reach. A model takes the next budget of the stage as
long as the last one lowered its mean validation error by more than the margin of non-inferiority. Every training starts
afresh, as a learning rate that fades with the budget cannot be continued.
"""

from collections.abc import Mapping, Sequence

import numpy as np

from cconv.study.declared.stage_tables import reads_of
from cconv.study.evidence.budget import still_falling
from cconv.study.stages.finalists import Finalist, finalist_jobs, finalist_training, retrained_finalists
from cconv.study.stages.search import train_all
from cconv.study.stages.session import Session


def train_longer(session: Session, stage: str) -> dict:
    """Train the finalists that the stage names with its budgets, one after another.

    Returns:
        "finalists", the hyperparameters of the longest training of each model, by an id that ends in its updates; and
        "convergence", by model: "points", an entry a budget ("id", "updates", "valid_normalized_mse", mean over the
        seeds, "by_seed", "train_seconds"), and "still_falling", whether the last budget still lowered the error.
    """
    study, settings = session.study, session.study.stages[stage]
    own = finalist_training(study)
    models = _named(_trained_finalists(session, stage), settings.of)
    points = {name: [point] for name in models if (point := _point(session, name, own.updates))}
    going = list(points)
    for updates in settings.budgets:
        training = own.model_copy(update={"updates": updates})
        longer = [Finalist(id=f"{name}_after_{updates}", parameters=models[name]) for name in going]
        jobs = finalist_jobs(longer, study.finalists.seeds, study.seeds.init + 1, session.run)
        train_all(session, stage, jobs, training)
        ends = {name: _point(session, f"{name}_after_{updates}", updates) for name in going}
        for name in going:
            points[name] += [ends[name]] if ends[name] else []
        going = [name for name in going if ends[name] and still_falling(points[name], study.selection.margin)]
    return {
        "finalists": {each[-1]["id"]: models[name] for name, each in points.items() if len(each) > 1},
        "convergence": {name: {"points": each, "still_falling": name in going} for name, each in points.items()},
    }


def _trained_finalists(session: Session, stage: str) -> dict[str, dict]:
    """Hyperparameters of the finalists that were trained, and not fitted, by id."""
    retrainings = session.run.retrainings()
    found: dict[str, dict] = {}
    for name in reads_of(session.study.stages, stage):
        found |= session.run.result(name)["finalists"]
    return {name: each for name, each in found.items() if not retrainings[name][0].is_closed_form}


def _named(models: Mapping[str, dict], names: Sequence[str] | None) -> dict[str, dict]:
    return {name: each for name, each in models.items() if names is None or name in names}


def _point(session: Session, finalist: str, updates: int) -> dict | None:
    """Mean validation error of a finalist's trainings with one budget; None if not all of them finished."""
    retrained, _ = retrained_finalists(session.run, [finalist], session.study.finalists.seeds)
    if not retrained:
        return None
    records, errors = retrained[0].records, retrained[0].valid_errors
    return {
        "id": finalist,
        "updates": updates,
        "valid_normalized_mse": float(np.mean(errors)),
        "by_seed": dict(zip([record.id for record in records], errors, strict=True)),
        "train_seconds": float(np.mean([record.log[-1]["seconds"] for record in records])),
    }
