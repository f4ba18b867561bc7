"""The common part of the searches: number of trials, search space, and early stopping by ASHA."""

from abc import abstractmethod
from collections.abc import Iterator

from cconv.study.declared.stage import Stage, Trials
from cconv.study.records.found import Found
from cconv.study.records.rungs import RungFile
from cconv.study.running.trial_queue import Job, StopsByRungs, TrialQueue
from cconv.study.stages.session import Session
from cconv.validation import Name


class SearchStage(Stage):
    """A stage that trains `trials` configurations and stops bad ones early (ASHA).

    Configurations come from the study's space, or from the one narrowed by the stage `space`.
    """

    space_kinds = ("refine",)
    counts_updates = True
    trials: Trials = 16
    space: Name | None = None

    @property
    def space_from(self) -> str | None:
        """The stage whose narrowed space this one searches; None means the study's own space."""
        return self.space

    @abstractmethod
    def jobs(self, session: Session, name: str) -> Iterator[Job]:
        """Yield the trials of the search, each made when it is asked for."""

    def run(self, session: Session, name: str) -> Found:
        """Train the trials; a trial that ASHA stops is not trained further."""
        study = session.study
        file = RungFile(session.run.path / "rungs.json")
        table = file.table(name, study.rungs, study.search.reduction_factor)
        judge = StopsByRungs(file, name, table, study.search.give_up_above)
        session.observer.on_stage(name, self.trials, study.training)
        queue = TrialQueue(self.jobs(session, name), study.training, judge, session.observers(mirrored=True))
        session.start_pool().run(queue, name, study.training)
        return Found()
