"""Stages that only read records: the refined space (thesis, 4.3.1), and how important hyperparameters are."""

from cconv.study.evidence.importance import importance_by_rung
from cconv.study.evidence.narrowed_space import refine, write_space
from cconv.study.evidence.partial_dependence import partial_dependence
from cconv.study.stages.session import Session

SHOWN = 6  # parameters whose partial dependence is kept


def refine_space(session: Session, stage: str) -> dict:
    """Narrow the study's space from the records that the stage reads; written to ``stages/<stage>.toml``."""
    space, reasons = refine(session.space, session.read(stage), session.study.training.updates)
    path = session.run.path / "stages" / f"{stage}.toml"
    path.parent.mkdir(exist_ok=True)
    write_space(space, path)
    return {"refined": reasons}


def measure_importance(session: Session, stage: str) -> dict:
    """Importance of every hyperparameter at every rung of the random searches that the stage reads.

    A trial that is given up counts as one that learned nothing, so that errors count up to where trials are given up.
    """
    records, space, seed = session.read(stage), session.space, session.seed_of(stage)
    useless = min(session.useless_error, session.study.search.give_up_above)
    importance = importance_by_rung(records, space, session.study.rungs, seed=seed, useless_error=useless)
    first = next((entry for entry in importance if entry["parameters"]), None)  # the fewest trials had been stopped
    if first is None:
        return {"importance": importance}
    shares = {name: each["share"] or 0.0 for name, each in first["parameters"].items()}
    strongest = sorted(shares, key=shares.__getitem__, reverse=True)[:SHOWN]
    dependences = [
        partial_dependence(records, space, first["updates"], parameter, seed=seed, useless_error=useless)
        for parameter in strongest
    ]
    return {"importance": importance, "partial_dependence": dependences}
