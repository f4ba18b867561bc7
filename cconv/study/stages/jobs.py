"""What stages have trained: jobs named after the stage, each trained to the full budget.

Every trial is a function of the study's seeds and of records, never of a sampler's memory. So a stage that was killed
goes on as it would have, and one that finished takes more trials.
"""

from collections.abc import Mapping, Sequence

from cconv.study.declared.configuration import TrainingConfig
from cconv.study.records.trials import TrialFolder
from cconv.study.running.trial_queue import Job, NothingStops, TrialQueue, job_in
from cconv.study.stages.session import Session


def trial_name(stage: str, number: int) -> str:
    """Id of a stage's trial."""
    return f"{stage}_{number:04d}"


def trial_job(session: Session, stage: str, number: int, parameters: Mapping, init_seed: int | None = None) -> Job:
    """A trial of a stage, with the seed that all trials of searches share unless another is given."""
    name = trial_name(stage, number)
    seed = session.study.seeds.init if init_seed is None else init_seed
    return job_in(session.run.trial(name), name, parameters, seed)


def train_all(session: Session, stage: str, jobs: Sequence[Job], training: TrainingConfig) -> None:
    """Train every job to the full budget of `training`."""
    session.observer.on_stage(stage, len(jobs), training.updates)
    queue = TrialQueue(jobs, training.updates, NothingStops(), session.observers(mirrored=False))
    if any(not TrialFolder(job.folder).ended for job in jobs):
        session.start_pool().run(queue, stage, training)
