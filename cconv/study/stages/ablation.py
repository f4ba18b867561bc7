"""The ablation stage: what each change between the baseline and the best model brings, by real retrainings.

One path changes one hyperparameter after another from the baseline to the best trained finalist. And the best finalist
of all is built anew with each of its branches and features turned over: what it has left out, what it lacks added.
"""

from collections.abc import Mapping, Sequence

import numpy as np

from cconv.study.declared.configuration import configure
from cconv.study.declared.stage_tables import BASELINE, reads_of
from cconv.study.evidence.ablation_path import ablation_order, path_configurations
from cconv.study.evidence.surrogate import FEWEST_TRIALS
from cconv.study.stages.closed_form import fit_whole
from cconv.study.stages.finalists import Finalist, Retrained, finalist_jobs, finalist_training, retrained_finalists
from cconv.study.stages.search import train_all
from cconv.study.stages.session import Session
from cconv.tasks.features import WALLS


def ablate(session: Session, stage: str) -> dict:
    """Retrain the path and the turned-over models; returns "ablation" with "path" and "branches".

    A step of the path above the space's caps on cost is not trained and has no error.
    """
    finalists = _finalists(session, stage)
    trained = [finalist for finalist in finalists if not finalist.records[0].is_closed_form]
    found = [finalist for finalist in trained if finalist.id != BASELINE]
    path = _path(session, stage, found) if found else {}
    best = min(finalists, key=_mean_error)
    branches = _turned_over(session, best)
    seeds, first = session.study.stages[stage].seeds, session.study.seeds.init + 1
    to_train = path if best.records[0].is_closed_form else path | branches
    affordable = {name: each for name, each in to_train.items() if session.affordable(each)}
    jobs = finalist_jobs(
        [Finalist(id=f"{stage}_{name}", parameters=each) for name, each in affordable.items()],
        seeds,
        first,
        session.run,
    )
    train_all(session, stage, jobs, finalist_training(session.study))
    if best.records[0].is_closed_form:
        for name, parameters in branches.items():
            folder = session.run.finalist(f"{stage}_{name}", first)
            fit_whole(session, parameters, folder, stage, first, best.records[0].config["ridge"])
    return {
        "ablation": {
            "of": best.id,
            "path": [_entry(session, f"{stage}_{name}", name, each) for name, each in path.items()],
            "branches": [
                _entry(session, f"{stage}_{name}", name, each) | {"left_out": name, "of": _mean_error(best)}
                for name, each in branches.items()
            ],
        }
    }


def _finalists(session: Session, stage: str) -> list[Retrained]:
    names = [name for name in reads_of(session.study.stages, stage) if session.study.stages[name].kind == "finalists"]
    ids = [each for name in names for each in session.run.result(name)["finalists"]]
    return retrained_finalists(session.run, ids, session.study.finalists.seeds)[0]


def _path(session: Session, stage: str, found: Sequence[Retrained]) -> dict[str, dict]:
    """Configurations from the baseline to the best trained finalist, by the hyperparameter that each one changes.

    The order comes from a surrogate of the errors at the highest rung that enough trials reached; none where the study
    is too small for that.
    """
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


def _turned_over(session: Session, best: Retrained) -> dict[str, dict]:
    """The best finalist with each branch or feature that the scene offers turned over."""
    parameters = best.records[0].parameters
    features = configure(parameters, session.study.configuration).features
    optional = session.problem.task.optional
    offered = [name for name in optional if name != WALLS or session.problem.scene.has_boundary]
    return {name: parameters | {name: name not in features} for name in offered}


def _entry(session: Session, finalist: str, change: str, parameters: Mapping) -> dict:
    records = session.run.retrainings().get(finalist, [])
    errors = [record.best for record in records if record.outcome == "completed"]
    return {
        "change": change,
        "parameters": dict(parameters),
        "valid_normalized_mse": float(np.mean(errors)) if errors else None,
        "low": min(errors, default=None),
        "high": max(errors, default=None),
        "flops_per_particle": records[0].config["flops_per_particle"] if records else None,
        "num_parameters": records[0].config["num_parameters"] if records else None,
    }


def _mean_error(finalist: Retrained) -> float:
    return float(np.mean(finalist.valid_errors))
