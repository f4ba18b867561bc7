"""The initialisation stage (thesis, 4.1): the luck of initial weights beside the choice of a configuration.

The baseline is trained with many seeds, and many random configurations with one seed; nothing is stopped. So the same
trainings tell at every rung how much of the spread is luck, and how well a rung foretells the full budget.
"""

from cconv.study.evidence.rung_audit import audit_rungs
from cconv.study.evidence.seed_variance import variance_decomposition
from cconv.study.evidence.strategies import compare_strategies, learning_curves
from cconv.study.records.run_folder import RunFolder
from cconv.study.records.trials import TrialRecord
from cconv.study.running.sampling import random_parameters
from cconv.study.stages.search import train_all, trial_job
from cconv.study.stages.session import Session


def train_unstopped(session: Session, stage: str) -> dict:
    """Train the baseline with many seeds and many configurations with one; compare their spreads, audit the rungs."""
    study, settings = session.study, session.study.stages[stage]
    first = study.seeds.init + 1 + study.finalists.seeds  # seeds that no other stage uses
    draws = [
        random_parameters(session.space, session.seed_of(stage), number, session.affordable)
        for number in range(settings.configurations)
    ]
    trainings = [(session.space.baseline, first + number) for number in range(settings.seeds)]
    trainings += [(parameters, study.seeds.init) for parameters in draws]
    jobs = [trial_job(session, stage, number, *training) for number, training in enumerate(trainings)]
    train_all(session, stage, jobs, study.training)
    seeds, configurations = by_purpose(session.run, stage, study.seeds.init)
    completed = [record for record in configurations if record.outcome == "completed"]
    seed, factor = session.seed_of(stage), study.search.reduction_factor
    return {
        "initialization": variance_decomposition(seeds, configurations, study.rungs),
        "rung_audit": audit_rungs(completed, study.rungs[:-1], kept=1 / factor),
        "strategies": compare_strategies(learning_curves(completed), study.rungs, factor, seed=seed),
    }


def by_purpose(run: RunFolder, stage: str, search_seed: int) -> tuple[list[TrialRecord], list[TrialRecord]]:
    """The stage's trainings of the baseline with many seeds, and those of many configurations with the search's."""
    records = run.trials_of(stage)
    configurations = [record for record in records if record.config["init_seed"] == search_seed]
    return [record for record in records if record not in configurations], configurations
