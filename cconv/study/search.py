"""Trials in parallel with Ray Tune: random and adaptive search with ASHA, and plain lists of trainings."""

import os
import shutil
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import count
from pathlib import Path

from cconv.study.config import StudyConfig, TrainingConfig
from cconv.study.observer import Observer
from cconv.study.problem import Problem, provenance
from cconv.study.records import DIVERGED_ERROR, RunFolder, TrialFolder
from cconv.study.space import SearchSpace, optuna_distributions, ray_domains

METRIC = "valid_normalized_mse"
RAY_OBJECT_STORE_BYTES = 2**30


@dataclass(frozen=True, kw_only=True)
class Job:
    """One training.

    Attributes:
        folder: Where it is recorded.
        name: Name to show.
        parameters: Hyperparameters.
        init_seed: Seed of the initial weights.
    """

    folder: Path
    name: str
    parameters: dict
    init_seed: int


@dataclass(frozen=True, kw_only=True)
class Session:
    """What all stages of a run share.

    Attributes:
        study: The study.
        space: Its search space.
        problem: Scene, task and samples.
        run: Where everything is recorded.
        observer: Sees the trials as they run.
    """

    study: StudyConfig
    space: SearchSpace
    problem: Problem
    run: RunFolder
    observer: Observer

    @property
    def ray_folder(self) -> Path:
        """Ray's own files, which nothing of ours reads."""
        return self.run.path.absolute() / "ray"


@contextmanager
def ray_session(session: Session) -> Iterator[None]:
    """A private Ray on this machine with one core a trial; its files go when it ends."""
    os.environ.update(
        RAY_AUTH_MODE="disabled",  # tokens would be written to the home folder
        RAY_USAGE_STATS_ENABLED="0",
        RAY_CHDIR_TO_TRIAL_DIR="0",  # data paths stay valid
        RAY_AIR_NEW_OUTPUT="0",  # its boxes are printed even when silent
        RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO="0",  # leave the accelerators' variables alone
        TUNE_DISABLE_SIGINT_HANDLER="1",  # Ctrl-C is ours
        TUNE_DISABLE_AUTO_CALLBACK_LOGGERS="1",  # our records are the truth
        TUNE_WARN_EXCESSIVE_EXPERIMENT_CHECKPOINT_SYNC_THRESHOLD_S="0",
        TUNE_WARN_THRESHOLD_S="60",
    )
    import ray

    try:
        ray.init(
            num_cpus=session.study.concurrency,
            include_dashboard=False,
            log_to_driver=False,
            logging_level="ERROR",
            object_store_memory=RAY_OBJECT_STORE_BYTES,
        )
        yield
    finally:
        ray.shutdown()
        shutil.rmtree(session.ray_folder, ignore_errors=True)


def random_search(session: Session) -> None:
    """Random search with ASHA, the baseline first."""
    from ray.tune.search.basic_variant import BasicVariantGenerator

    seed = session.study.seeds.search
    sampler = BasicVariantGenerator(points_to_evaluate=[session.space.baseline], random_state=seed)
    _search(session, "random", session.study.search.random_trials, sampler, ray_domains(session.space))


def adaptive_search(session: Session) -> None:
    """Tree-structured Parzen estimator (Optuna) with ASHA, the baseline first; it knows the random trials' errors."""
    from optuna.samplers import TPESampler

    from cconv.study.asha import RungAwareOptunaSearch
    from cconv.study.optuna_mirror import mirror_trials, open_journal

    study, space = session.study, session.space
    journal = open_journal(session.run.path / "optuna.journal")
    searched = [record for record in session.run.trials() if record.stage == "random"]
    mirror_trials(searched, space, study.training.updates, journal, study.name)
    sampler = RungAwareOptunaSearch(
        optuna_distributions(space),
        metric=METRIC,
        mode="min",
        points_to_evaluate=[space.baseline],
        sampler=TPESampler(seed=study.seeds.search, multivariate=True, constant_liar=True),
        study_name=study.name,
        storage=journal,
        max_updates=study.training.updates,
    )
    _search(session, "adaptive", study.search.adaptive_trials, sampler, {})


def run_jobs(session: Session, jobs: Sequence[Job], stage: str, training: TrainingConfig) -> None:
    """Train every job to the full budget of `training`."""
    from ray.tune.schedulers import FIFOScheduler
    from ray.tune.search.basic_variant import BasicVariantGenerator

    jobs = list(jobs)
    session.observer.on_stage(stage, len(jobs), training.updates)
    _fit(
        session,
        stage,
        training,
        job_of=lambda name, parameters: jobs[parameters["job"]],
        name_of=lambda trial: jobs[trial.config["job"]].name,
        param_space={"job": _grid(range(len(jobs)))},
        metric={"metric": METRIC, "mode": "min"},
        num_samples=1,
        scheduler=FIFOScheduler(),
        search_alg=BasicVariantGenerator(),
    )


def _search(session: Session, stage: str, num_trials: int, sampler, param_space: dict) -> None:
    from cconv.study.asha import RecordedASHA

    study, run = session.study, session.run
    scheduler = RecordedASHA(
        run.path / "rungs.json",
        stage,
        max_updates=study.training.updates,
        grace_updates=study.search.grace_updates,
        reduction_factor=study.search.reduction_factor,
        metric=METRIC,
        give_up_above=study.search.give_up_above,
    )
    init_seed, numbers = study.seeds.init, count()

    def job_of(name: str, parameters: dict) -> Job:
        return Job(folder=run.trial(name).path, name=name, parameters=parameters, init_seed=init_seed)

    session.observer.on_stage(stage, num_trials, study.training.updates)
    _fit(
        session,
        stage,
        study.training,
        job_of=job_of,
        name_of=lambda trial: f"{stage}_{next(numbers):04d}",
        param_space=param_space,
        metric={},  # the scheduler and the sampler have it
        num_samples=num_trials,
        scheduler=scheduler,
        search_alg=sampler,
    )


def _fit(
    session: Session,
    stage: str,
    training: TrainingConfig,
    *,
    job_of: Callable[[str, dict], Job],
    name_of: Callable[..., str],
    param_space: dict,
    metric: dict,
    **tune_settings,
) -> None:
    from ray import tune

    from cconv.study.recorder import Recorder

    study = session.study

    def trainable(parameters: dict, shared: dict) -> None:
        job = shared["job_of"](tune.get_context().get_trial_name(), parameters)
        _train_and_report(job, stage, training, shared["problem"], shared["study"])

    shared = {"job_of": job_of, "problem": session.problem, "study": study}
    tuner = tune.Tuner(
        tune.with_resources(tune.with_parameters(trainable, shared=shared), {"cpu": 1}),
        param_space=param_space,
        tune_config=tune.TuneConfig(
            max_concurrent_trials=study.concurrency,
            reuse_actors=True,
            trial_name_creator=name_of,
            trial_dirname_creator=lambda trial: trial.trial_id,
            **metric,
            **tune_settings,
        ),
        run_config=tune.RunConfig(
            name=stage,
            storage_path=str(session.ray_folder),
            callbacks=[Recorder(session.observer, job_of, stage, training.updates)],
            progress_reporter=_silent_reporter(),
            verbose=0,
        ),
    )
    tuner.fit()


def _train_and_report(job: Job, stage: str, training: TrainingConfig, problem: Problem, study: StudyConfig) -> None:
    import torch
    from ray import tune

    from cconv.study.trial import run_trial

    torch.set_num_threads(1)
    cache_megabytes = training.cache_megabytes // study.concurrency
    folder = TrialFolder(job.folder)
    trial = run_trial(
        problem,
        job.parameters,
        study.network,
        training.model_copy(update={"cache_megabytes": cache_megabytes}),
        folder,
        stage=stage,
        init_seed=job.init_seed,
        data_seed=study.seeds.data,
        provenance=provenance(study),
    )
    try:
        for entry in trial:
            tune.report(entry | {METRIC: DIVERGED_ERROR if entry["diverged"] else entry[METRIC]})
    except Exception as error:
        folder.finish("failed", str(error) or type(error).__name__)
        raise


def _grid(values):
    from ray import tune

    return tune.grid_search(list(values))


def _silent_reporter():
    from ray.tune import ProgressReporter

    class Silent(ProgressReporter):
        def should_report(self, trials, done=False):
            return False

        def report(self, trials, done, *sys_info):
            return None

    return Silent()
