"""Training of a job in this process, for every pool: its failures are recorded and do not end the process."""

from collections.abc import Generator, Iterator
from typing import NamedTuple

from cconv.errors import ConfigError, is_disk_full
from cconv.study.declared.configuration import TrainingConfig
from cconv.study.declared.study_file import StudyConfig
from cconv.study.records.trials import TrialFolder
from cconv.study.running.attempt import Attempt
from cconv.study.running.problem import Problem, provenance
from cconv.study.running.trial import Trial, run_trial
from cconv.study.running.trial_queue import Job
from cconv.training.loop import TrainingState

HANGING = 2.0  # times its limit a training may take before its process is ended
DISK_FULL = "disk full"


class Report(NamedTuple):
    """A report of a training: an evaluation or the outcome.

    Attributes:
        entry: The last evaluation; zero updates before the first.
        outcome: "failed", "stopped" at the time limit, or `DISK_FULL`, if the training ended by itself; else None.
        reason: The reason for the outcome, or "".
    """

    entry: dict
    outcome: str | None = None
    reason: str = ""


def train_recorded(
    job: Job, stage: str, training: TrainingConfig, study: StudyConfig, problem: Problem
) -> Generator[Report, None, None]:
    """Train a job and yield a report for every evaluation, and for the outcome if the training ends by itself.

    An error of the training is an outcome of the job, not an exception. If the training hangs, this process is ended.
    """
    limit = _seconds_limit(study, training)
    last: dict = {"updates": 0, "valid_error": None, "diverged": False, "seconds": 0.0}
    outcome, reason = None, ""
    try:
        with Attempt(job.folder, HANGING * limit) as attempt:
            for last in _trial(job, stage, training, study, problem, attempt):
                yield Report(last)
        if not last["diverged"] and not training.is_spent(last):
            outcome, reason = "stopped", f"it trained longer than its limit of {limit:g} seconds"
    except Exception as error:
        outcome, reason = DISK_FULL if is_disk_full(error) else "failed", str(error) or type(error).__name__
    if outcome is not None:
        if outcome == "failed":
            record_what_failed(job, stage)
        yield Report(last, outcome, reason)


def disk_is_full(job: Job, reason: str) -> ConfigError:
    """Make the error that ends a run in which a training found the disk full."""
    return ConfigError(f"{job.folder}: {reason}; make room, then `cconv study resume`.")


def _seconds_limit(study: StudyConfig, training: TrainingConfig) -> float:
    """Return the time limit of a training: that of a trial, or more in proportion to a budget beyond a trial's."""
    return study.search.trial_seconds * max(1.0, training.updates / study.training.updates)


def _trial(
    job: Job, stage: str, training: TrainingConfig, study: StudyConfig, problem: Problem, attempt: Attempt
) -> Iterator[dict]:
    def check_before_writing(state: TrainingState) -> None:
        if state.valid_error is not None or state.diverged:
            attempt.check()

    folder = TrialFolder(job.folder)
    yield from folder.log()[-1:]  # an earlier attempt may have died before the judge saw it
    trial = Trial(
        stage=stage,
        parameters=job.parameters,
        init_seed=job.init_seed,
        data_seed=study.seeds.data,
        provenance=provenance(study),
        loggers=study.log,
    )
    yield from run_trial(
        problem,
        trial,
        study.configuration._replace(training=training),
        folder,
        seconds_limit=_seconds_limit(study, training),
        on_update=check_before_writing,
    )


def record_what_failed(job: Job, stage: str) -> None:
    """Write the configuration of a job that failed, if it failed before it wrote it, so that its record can be read."""
    folder = TrialFolder(job.folder)
    if not folder.started:
        known = {"stage": stage, "parameters": job.parameters, "init_seed": job.init_seed}
        folder.start(known | {"num_parameters": None, "flops_per_particle": None})
