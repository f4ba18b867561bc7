"""The random stage draws independent configurations from the space and stops bad trials early (ASHA)."""

from collections.abc import Iterator
from typing import Literal

from cconv.study.running.sampling import random_parameters
from cconv.study.running.trial_queue import Job
from cconv.study.stages.jobs import trial_job
from cconv.study.stages.search import SearchStage
from cconv.study.stages.session import Session


class RandomStage(SearchStage):
    """Search at random with early stopping (ASHA), in the study's space or in the one narrowed by the stage `space`."""

    kind: Literal["random"] = "random"

    def jobs(self, session: Session, name: str) -> Iterator[Job]:
        """Yield the trials, each drawn from a random stream of its own."""
        space, seed = session.space_of(name), session.seed_of(name)
        for number in range(self.trials):
            yield trial_job(session, name, number, random_parameters(space, seed, number, session.affordable))
