"""Trials in parallel with Ray Tune: random and adaptive search with ASHA, and plain lists of trainings."""

import os
import shutil
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from cconv.study.config import StudyConfig, TrainingConfig
from cconv.study.observer import Observer
from cconv.study.problem import Problem, provenance
from cconv.study.records import RunFolder, TrialFolder
from cconv.study.space import SearchSpace, optuna_distributions, ray_domains

METRIC = "valid_normalized_mse"
# Ray and Optuna need a finite number where a trial diverged; our records hold none there.
DIVERGED_ERROR = 1e9


@dataclass(frozen=True, kw_only=True)
class Job:
    """One training of a list.

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


@contextmanager
def ray_session(concurrency: int) -> Iterator[Path]:
    """A private Ray on this machine with one core a trial; yields the folder of its disposable files."""
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

    storage = Path(tempfile.mkdtemp(prefix="cconv-ray-"))
    try:
        ray.init(
            num_cpus=concurrency,
            include_dashboard=False,
            log_to_driver=False,
            logging_level="ERROR",
            object_store_memory=512 * 2**20,
        )
        yield storage
    finally:
        ray.shutdown()
        shutil.rmtree(storage, ignore_errors=True)


def random_search(
    study: StudyConfig, space: SearchSpace, problem: Problem, run: RunFolder, storage: Path, observer: Observer
) -> None:
    """Random search with ASHA, the baseline first."""
    from ray.tune.search.basic_variant import BasicVariantGenerator

    num_trials = study.search.random_trials
    sampler = BasicVariantGenerator(points_to_evaluate=[space.baseline], random_state=study.seeds.search)
    _search("random", num_trials, sampler, ray_domains(space), study, problem, run, storage, observer)


def adaptive_search(
    study: StudyConfig, space: SearchSpace, problem: Problem, run: RunFolder, storage: Path, observer: Observer
) -> None:
    """Tree-structured Parzen estimator (Optuna) with ASHA, the baseline first; it knows the random trials' errors."""
    from optuna.samplers import TPESampler

    from cconv.study.asha import RungAwareOptunaSearch
    from cconv.study.optuna_mirror import mirror_trials, open_journal

    storage_of_study = open_journal(run.path / "optuna.journal")
    mirror_trials(run.trials(), space, study.training.updates, storage_of_study, study.name)
    sampler = RungAwareOptunaSearch(
        optuna_distributions(space),
        metric=METRIC,
        mode="min",
        points_to_evaluate=[space.baseline],
        sampler=TPESampler(seed=study.seeds.search, multivariate=True, constant_liar=True),
        study_name=study.name,
        storage=storage_of_study,
        max_updates=study.training.updates,
    )
    _search("adaptive", study.search.adaptive_trials, sampler, {}, study, problem, run, storage, observer)


def _search(
    stage: str, num_trials: int, sampler, param_space: dict, study: StudyConfig, problem: Problem, run: RunFolder,
    storage: Path, observer: Observer,
) -> None:  # fmt: skip
    from ray import tune

    from cconv.study.asha import RecordedASHA
    from cconv.study.recorder import Recorder

    def trainable(parameters: dict, shared: dict) -> None:
        name = tune.get_context().get_trial_name()
        _report(parameters, shared["run"].trial(name), stage, study.seeds.init, **shared["common"])

    scheduler = RecordedASHA(
        run.path / "rungs.json",
        stage,
        max_updates=study.training.updates,
        grace_updates=study.search.grace_updates,
        reduction_factor=study.search.reduction_factor,
        metric=METRIC,
        give_up_above=study.search.give_up_above,
    )
    observer.on_stage(stage, num_trials, study.training.updates)
    shared = {"run": run, "common": _common(study, study.training, problem)}
    callback = Recorder(observer, run.trial, study.training.updates)
    _fit(
        tune.with_parameters(trainable, shared=shared), param_space, stage, num_trials, scheduler, sampler, callback,
        study.concurrency, storage,
    )  # fmt: skip


def run_jobs(
    jobs: Sequence[Job],
    stage: str,
    study: StudyConfig,
    training: TrainingConfig,
    problem: Problem,
    storage: Path,
    observer: Observer,
) -> None:
    """Train every job to the full budget of `training`."""
    from ray import tune
    from ray.tune.schedulers import FIFOScheduler
    from ray.tune.search.basic_variant import BasicVariantGenerator

    from cconv.study.recorder import Recorder

    def trainable(parameters: dict, shared: dict) -> None:
        job = shared["jobs"][parameters["job"]]
        _report(job.parameters, TrialFolder(job.folder), stage, job.init_seed, **shared["common"])

    observer.on_stage(stage, len(jobs), training.updates)
    folders = {job.name: TrialFolder(job.folder) for job in jobs}
    callback = Recorder(observer, folders.__getitem__, training.updates)
    shared = {"jobs": list(jobs), "common": _common(study, training, problem)}
    _fit(
        tune.with_parameters(trainable, shared=shared), {"job": tune.grid_search(list(range(len(jobs))))}, stage, 1,
        FIFOScheduler(), BasicVariantGenerator(), callback, study.concurrency, storage,
        names=[job.name for job in jobs],
    )  # fmt: skip


def _common(study: StudyConfig, training: TrainingConfig, problem: Problem) -> dict:
    return {
        "problem": problem,
        "network": study.network,
        "training": training,
        "data_seed": study.seeds.data,
        "provenance": provenance(study),
    }


def _report(parameters: dict, folder: TrialFolder, stage: str, init_seed: int, **common) -> None:
    import torch
    from ray import tune

    from cconv.study.trial import run_trial

    torch.set_num_threads(1)
    trial = run_trial(
        common["problem"], parameters, common["network"], common["training"], folder,
        stage=stage, init_seed=init_seed, data_seed=common["data_seed"], provenance=common["provenance"],
    )  # fmt: skip
    for entry in trial:
        tune.report(entry | {METRIC: DIVERGED_ERROR if entry["diverged"] else entry[METRIC]})


def _fit(
    trainable, param_space: dict, stage: str, num_samples: int, scheduler, sampler, callback, concurrency: int,
    storage: Path, names: Sequence[str] | None = None,
) -> None:  # fmt: skip
    from ray import tune

    count = iter(range(10**9))
    tuner = tune.Tuner(
        tune.with_resources(trainable, {"cpu": 1}),
        param_space=param_space,
        tune_config=tune.TuneConfig(
            metric=None if hasattr(scheduler, "_metric") else METRIC,
            mode=None if hasattr(scheduler, "_metric") else "min",
            search_alg=sampler,
            scheduler=scheduler,
            num_samples=num_samples,
            max_concurrent_trials=concurrency,
            reuse_actors=True,
            trial_name_creator=lambda trial: names[next(count)] if names else f"{stage}_{next(count):04d}",
            trial_dirname_creator=lambda trial: trial.trial_id,
        ),
        run_config=tune.RunConfig(
            name=stage, storage_path=str(storage), callbacks=[callback], verbose=0, progress_reporter=_silent_reporter()
        ),
    )
    tuner.fit()


def _silent_reporter():
    from ray.tune import ProgressReporter

    class Silent(ProgressReporter):
        def should_report(self, trials, done=False):
            return False

        def report(self, trials, done, *sys_info):
            return None

    return Silent()
