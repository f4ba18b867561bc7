"""The initialisation stage (thesis, 4.1) compares the variance of the error over seeds with that over configurations.

The baseline is trained with many seeds, and many random configurations with one seed, all to the full budget. So the
same trainings show at every rung how much of the variance comes from the initial weights, and how well the order of
trials at the rung predicts their order at the full budget.
"""

from typing import Literal

from pydantic import Field

from cconv.study.declared.stage import MOST_TRIALS, Stage
from cconv.study.evidence.rung_audit import audit_rungs
from cconv.study.evidence.seed_variance import variance_decomposition
from cconv.study.evidence.strategies import compare_strategies, learning_curves
from cconv.study.records.found import Found
from cconv.study.records.run_folder import RunFolder
from cconv.study.records.trials import TrialRecord
from cconv.study.running.sampling import random_parameters
from cconv.study.running.trial_queue import Job
from cconv.study.stages.jobs import train_all, trial_job
from cconv.study.stages.session import Session
from cconv.validation import Whole


class InitializationStage(Stage):
    """Train the baseline with `seeds` initial weights and `configurations` random configurations with one seed.

    No training is stopped early. The stage measures the seed variance, audits the rungs and replays stopping rules.
    """

    kind: Literal["initialization"] = "initialization"
    counts_updates = True
    is_single = True
    seeds: Whole = Field(5, ge=2, le=1000)
    configurations: Whole = Field(16, ge=2, le=MOST_TRIALS)

    def run(self, session: Session, name: str) -> Found:
        """Train them and return both variances, the audit of the rungs and the replayed stopping rules."""
        study, seed = session.study, session.seed_of(name)
        train_all(session, name, self._jobs(session, name), study.training)
        seeds, configurations = by_purpose(session.run, name, study.seeds.init)
        completed = [record for record in configurations if record.outcome == "completed"]
        factor = study.search.reduction_factor
        return Found(
            initialization=variance_decomposition(seeds, configurations, study.rungs),
            rung_audit=audit_rungs(completed, study.rungs[:-1], kept=1 / factor),
            strategies=compare_strategies(learning_curves(completed), study.rungs, factor, seed=seed),
        )

    def _jobs(self, session: Session, name: str) -> list[Job]:
        study, space = session.study, session.space
        first = study.seeds.init + 1 + study.finalists.seeds  # these seeds are used by no other stage
        trainings = [(space.baseline, first + number) for number in range(self.seeds)]
        for number in range(self.configurations):
            drawn = random_parameters(space, session.seed_of(name), number, session.affordable)
            trainings.append((drawn, study.seeds.init))
        return [trial_job(session, name, number, *training) for number, training in enumerate(trainings)]


def by_purpose(run: RunFolder, stage: str, search_seed: int) -> tuple[list[TrialRecord], list[TrialRecord]]:
    """Split the trainings into those of the baseline with many seeds and those with the search's seed."""
    records = run.trials_of(stage)
    configurations = [record for record in records if record.config["init_seed"] == search_seed]
    return [record for record in records if record not in configurations], configurations
