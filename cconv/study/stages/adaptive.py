"""The adaptive stage proposes each configuration from the trials before it and stops bad trials early (ASHA)."""

from collections.abc import Iterator, Sequence
from typing import Literal

from cconv.study.declared.domains import SearchSpace
from cconv.study.records.trials import TrialRecord
from cconv.study.running.sampling import suggest_parameters
from cconv.study.running.trial_queue import Job
from cconv.study.stages.jobs import trial_job, trial_name
from cconv.study.stages.search import SearchStage
from cconv.study.stages.session import Session
from cconv.validation import Value


class AdaptiveStage(SearchStage):
    """Search for small error and cost with a tree-structured Parzen estimator (TPE), and stop bad trials early (ASHA).

    The estimator learns from the trials of the stages that this one reads and from the earlier trials of its own.
    """

    kind: Literal["adaptive"] = "adaptive"
    uses = ("baseline", "initialization", "random")

    def jobs(self, session: Session, name: str) -> Iterator[Job]:
        """Yield the trials; each is proposed from the trials of the stages that are read and from those before it."""
        space, earlier = session.space_of(name), session.read(name)
        for number in range(self.trials):
            recorded = session.run.trial(trial_name(name, number)).parameters
            yield trial_job(session, name, number, recorded or _proposed(session, name, number, space, earlier))


def _proposed(
    session: Session, stage: str, number: int, space: SearchSpace, earlier: Sequence[TrialRecord]
) -> dict[str, Value]:
    """Propose the hyperparameters of a trial from the records that exist at this moment."""
    known = [*earlier, *session.run.trials_of(stage)]
    costs = {record.id: record.config["flops_per_particle"] for record in known}
    return suggest_parameters(
        space,
        [record for record in known if costs[record.id] is not None],  # the others failed before they began
        number=number,
        seed=session.seed_of(stage),
        full_updates=session.study.training.updates,
        affordable=session.affordable,
        costs=costs,
        useless_error=session.useless_error,
    )
