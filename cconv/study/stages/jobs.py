"""Jobs of a stage: trainings that are named after the stage.

Every trial depends only on the seeds of the study and on records, never on the state of a sampler. So an interrupted
stage continues as if nothing had happened, and a finished one can be extended by more trials.
"""

from collections.abc import Mapping, Sequence

from cconv.study.declared.configuration import TrainingConfig
from cconv.study.records.trials import TrialFolder
from cconv.study.running.trial_queue import Job, NothingStops, TrialQueue, job_in
from cconv.study.stages.session import Session


def trial_name(stage: str, number: int) -> str:
    """Return the id of a trial of a stage."""
    return f"{stage}_{number:04d}"


def trial_job(session: Session, stage: str, number: int, parameters: Mapping, init_seed: int | None = None) -> Job:
    """Make a trial of a stage; the default seed of the initial weights is the one that all searches share."""
    name = trial_name(stage, number)
    seed = session.study.seeds.init if init_seed is None else init_seed
    return job_in(session.run.trial(name), name, parameters, seed)


def train_all(session: Session, stage: str, jobs: Sequence[Job], training: TrainingConfig) -> None:
    """Train every job to the full budget of `training`, without early stopping."""
    session.observer.on_stage(stage, len(jobs), training)
    queue = TrialQueue(jobs, training, NothingStops(), session.observers(mirrored=False))
    if any(not TrialFolder(job.folder).ended for job in jobs):
        session.start_pool().run(queue, stage, training)
