"""The ablation stage retrains models to measure how much each change between the baseline and the best model brings.

Models on a path from the baseline to the best trained finalist differ from their predecessor in one hyperparameter. The
best finalist of all is also retrained, or refitted if it is a closed form, with each optional feature (walls, density)
removed if it has the feature and added if it lacks it.
"""

from collections.abc import Mapping, Sequence
from typing import Literal

import numpy as np
from pydantic import Field

from cconv.study.declared.configuration import configure, feature_path
from cconv.study.declared.stage import BASELINE, Stage, reads_of
from cconv.study.records.found import Ablation, AblationStep, Found
from cconv.study.stages.closed_form import fit_whole
from cconv.study.stages.finalists import Finalist, Retrained, finalist_jobs, finalist_training, retrained_finalists
from cconv.study.stages.jobs import train_all
from cconv.study.stages.session import Session
from cconv.tasks.features import WALLS
from cconv.validation import Whole


class AblationStage(Stage):
    """Retrain models between the baseline and the best finalist, and the best finalist with each feature toggled."""

    kind: Literal["ablation"] = "ablation"
    is_single = True
    uses = ("initialization", "random", "finalists")
    needs_records = True
    seeds: Whole = Field(1, ge=1, le=1000)

    def run(self, session: Session, name: str) -> Found:
        """Retrain the path and the toggled models and return the ablation.

        A model above the space's caps on cost is not trained and has no error.
        """
        finalists = _finalists(session, name)
        trained = [finalist for finalist in finalists if not finalist.records[0].is_closed_form]
        found = [finalist for finalist in trained if finalist.id != BASELINE]
        path = _path(session, name, found) if found else {}
        best = min(finalists, key=_mean_error)
        variants = toggled(session, best)
        if best.records[0].is_closed_form:
            self._train(session, name, path)
            _fit(session, name, variants, best.records[0].config["ridge"])
        else:
            self._train(session, name, path | variants)
        ablation = Ablation(
            of=best.id,
            error=_mean_error(best),
            path=[_step(session, f"{name}_{change}", change, each) for change, each in path.items()],
            toggled=[
                _step(session, f"{name}_{feature}", feature_path(feature), each) for feature, each in variants.items()
            ],
        )
        return Found(ablation=ablation)

    def _train(self, session: Session, name: str, models: Mapping[str, dict]) -> None:
        """Train the models that the space's caps on cost allow."""
        study = session.study
        affordable = [
            Finalist(id=f"{name}_{change}", parameters=each)
            for change, each in models.items()
            if session.affordable(each)
        ]
        jobs = finalist_jobs(affordable, self.seeds, study.seeds.init + 1, session.run)
        train_all(session, name, jobs, finalist_training(study))


def _fit(session: Session, stage: str, models: Mapping[str, dict], ridge: float) -> None:
    """Fit the models as closed forms."""
    seed = session.study.seeds.init + 1  # names the folder, as the seed of a training does
    for change, parameters in models.items():
        fit_whole(session, parameters, session.run.finalist(f"{stage}_{change}", seed), stage, seed, ridge)


def _finalists(session: Session, stage: str) -> list[Retrained]:
    names = [name for name in reads_of(session.study.stages, stage) if session.study.stages[name].kind == "finalists"]
    ids = [each for name in names for each in session.run.result(name).finalists]
    return retrained_finalists(session.run, ids, session.study.finalists.seeds)[0]


def _path(session: Session, stage: str, found: Sequence[Retrained]) -> dict[str, dict]:
    """List the configurations from the baseline to the best trained finalist, by the hyperparameter that each changes.

    The order comes from a surrogate of the errors at the highest rung that enough trials reached. The path is empty if
    no rung has enough trials.
    """
    # scikit-learn loads slowly, so only a running stage imports it.
    from cconv.study.evidence.ablation_path import ablation_order, path_configurations
    from cconv.study.evidence.surrogate import FEWEST_TRIALS

    best, baseline = min(found, key=_mean_error).records[0].parameters, session.space.baseline
    known = session.read(stage, "initialization", "random")
    errors = {updates: [record.error_at(updates) for record in known] for updates in session.study.rungs}
    enough = [updates for updates, at in errors.items() if len(at) - at.count(None) >= FEWEST_TRIALS]
    if not enough:
        return {}
    order = ablation_order(
        known, session.space, baseline, best, enough[-1], session.seed_of(stage), useless_error=session.useless_error
    )
    configurations = path_configurations(baseline, best, order, session.space)
    return dict(zip([BASELINE, *order], configurations, strict=True))


def toggled(session: Session, best: Retrained) -> dict[str, dict]:
    """Return the hyperparameters of the best finalist with one optional feature of the scene toggled, by feature."""
    parameters = best.records[0].parameters
    features = configure(parameters, session.study.configuration).features
    optional, present = session.problem.task.optional, session.problem.present_features
    offered = [name for name in optional if name in present and (name != WALLS or session.problem.scene.has_boundary)]
    return {name: parameters | {feature_path(name): name not in features} for name in offered}


def _step(session: Session, trained: str, change: str, parameters: Mapping) -> AblationStep:
    """What came of the trainings of a change, which have an id of their own."""
    records = session.run.retrainings().get(trained, [])
    errors = [record.best for record in records if record.outcome == "completed"]
    return AblationStep(
        change=change,
        parameters=parameters,
        valid_error=float(np.mean(errors)) if errors else None,
        low=min(errors, default=None),
        high=max(errors, default=None),
        flops_per_particle=records[0].config["flops_per_particle"] if records else None,
        num_parameters=records[0].config["num_parameters"] if records else None,
    )


def _mean_error(finalist: Retrained) -> float:
    return float(np.mean(finalist.valid_errors))
