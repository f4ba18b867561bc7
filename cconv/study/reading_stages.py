"""Stages that only read records: the refined space (thesis, 4.3.1), and how important hyperparameters are."""

from cconv.study.importance import importance_by_rung
from cconv.study.partial_dependence import partial_dependence
from cconv.study.refine import refine, write_space
from cconv.study.session import Session

SHOWN = 6  # parameters whose partial dependence is kept


def refine_space(session: Session, stage: str) -> dict:
    """Narrow the study's space from the records that the stage reads; written to ``stages/<stage>.toml``."""
    space, reasons = refine(session.space, session.read(stage), session.study.training.updates)
    path = session.run.path / "stages" / f"{stage}.toml"
    path.parent.mkdir(exist_ok=True)
    write_space(space, path)
    return {"refined": reasons}


def measure_importance(session: Session, stage: str) -> dict:
    """Importance of every hyperparameter at every rung of the random searches that the stage reads."""
    records, rungs, seed = session.read(stage), session.study.rungs, session.seed_of(stage)
    importance = importance_by_rung(records, session.space, rungs, seed=seed, useless_error=session.useless_error)
    if not importance:
        return {}
    first = importance[0]  # all trials were measured there, and none had been stopped
    weights = {name: each["importance"] for name, each in first["f_anova"]["parameters"].items()}
    strongest = sorted(weights, key=weights.__getitem__, reverse=True)[:SHOWN]
    dependences = [
        partial_dependence(
            records, session.space, first["updates"], parameter, seed=seed, useless_error=session.useless_error
        )
        for parameter in strongest
    ]
    return {"importance": importance, "partial_dependence": dependences}
