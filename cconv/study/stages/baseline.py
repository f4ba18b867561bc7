"""The baseline stage (thesis, 4.2) trains the baseline of the search space once to the full budget."""

from typing import Literal

from cconv.study.declared.stage import Stage
from cconv.study.records.found import Found
from cconv.study.stages.jobs import train_all, trial_job
from cconv.study.stages.session import Session


class BaselineStage(Stage):
    """Train the baseline, the published network in most spaces, to the full budget of a trial."""

    kind: Literal["baseline"] = "baseline"

    def run(self, session: Session, name: str) -> Found:
        """Train the baseline once, with the seed of the searches."""
        train_all(session, name, [trial_job(session, name, 0, session.space.baseline)], session.study.training)
        return Found()
