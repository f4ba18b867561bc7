"""The baseline stage (thesis, 4.2): the published network trained to the full budget, as every trial could be."""

from cconv.study.stages.search import train_all, trial_job
from cconv.study.stages.session import Session


def train_baseline(session: Session, stage: str) -> dict:
    """Train the baseline once, with the seed of the searches."""
    train_all(session, stage, [trial_job(session, stage, 0, session.space.baseline)], session.study.training)
    return {}
