"""Trainings in parallel with Ray Tune, on this machine or on a cluster."""

import os
import shutil
import socket
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

import torch

os.environ.update(
    RAY_USAGE_STATS_ENABLED="0",
    RAY_CHDIR_TO_TRIAL_DIR="0",  # data paths stay valid
    RAY_AIR_NEW_OUTPUT="0",  # its boxes are printed even when silent
    RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO="0",  # keep the variables of accelerators
    TUNE_DISABLE_SIGINT_HANDLER="1",  # we handle Ctrl-C
    TUNE_DISABLE_AUTO_CALLBACK_LOGGERS="1",  # results come from our records
    TUNE_WARN_EXCESSIVE_EXPERIMENT_CHECKPOINT_SYNC_THRESHOLD_S="0",
    TUNE_GLOBAL_CHECKPOINT_S="1000000",  # Ray's own state is never restored
    TUNE_WARN_THRESHOLD_S="60",
)

import ray  # noqa: E402, its settings are read at import
from ray import tune  # noqa: E402
from ray.exceptions import RayError  # noqa: E402
from ray.tune.schedulers import FIFOScheduler, TrialScheduler  # noqa: E402
from ray.tune.search import Searcher  # noqa: E402

from cconv.errors import ConfigError  # noqa: E402
from cconv.study.declared.configuration import TrainingConfig  # noqa: E402
from cconv.study.declared.study_file import StudyConfig  # noqa: E402
from cconv.study.running.private_folder import private_folder  # noqa: E402
from cconv.study.running.private_ray import (  # noqa: E402
    asking_once,
    check_token_of_cluster,
    demand_tokens,
    kill_processes_of,
    on_loopback_alone,
    token_of_this_run,
)
from cconv.study.running.problem import Problem, device_of  # noqa: E402
from cconv.study.running.recorded_training import DISK_FULL, disk_is_full, record_what_failed, train_recorded  # noqa: E402
from cconv.study.running.trial_queue import Job, TrialQueue  # noqa: E402

if TYPE_CHECKING:  # inner names of Ray, which a release may move
    from ray.tune.execution.tune_controller import TuneController
    from ray.tune.experiment import Trial as RayTrial

QUIET = {"log_to_driver": False, "logging_level": "CRITICAL"}  # failures are in our records
OBJECT_STORE_BYTES = 2**30
STARTS = 3  # attempts to start a private Ray; on a busy machine it may take longer than its limit of 30 seconds
CONNECTION_SECONDS = 5.0
RESTARTS = 2  # of a training whose process or node died; it continues from its last evaluation


@contextmanager
def ray_pool(study: StudyConfig, problem: Problem, folder: Path, address: str | None = None) -> Iterator["RayPool"]:
    """Start a private Ray with one core a training, or join the cluster at `address`; delete its files in the end.

    Raises:
        ConfigError: If Ray cannot start on this machine, or the cluster cannot be joined.
    """
    folder = folder.absolute()
    with ExitStack() as stack:
        stack.callback(shutil.rmtree, folder, ignore_errors=True)
        wish, gpus = _place(study)
        stack.enter_context(private_ray(study.concurrency, gpus) if address is None else _cluster(address))
        ray._private.worker._worker_logs_enabled = False  # our records say which training died
        yield RayPool(_with_wish(study, wish), problem, folder, gpus)


@contextmanager
def private_ray(cores: int, gpus: int = 0) -> Iterator[None]:
    """Start a Ray on this machine for so many trainings at once, which share so many GPUs.

    It listens on loopback only and demands a token.

    Raises:
        ConfigError: If it cannot start.
    """
    demand_tokens()
    with private_folder() as own, token_of_this_run(own), on_loopback_alone():
        try:
            _start(cores, gpus, own)
            yield
        finally:
            ray.shutdown()


@contextmanager
def _cluster(address: str) -> Iterator[None]:
    """Join the cluster at an address, which must demand the user's token."""
    demand_tokens()
    try:
        _join(address)
        yield
    finally:
        ray.shutdown()


def _start(cores: int, gpus: int, folder: Path) -> None:
    """Start a Ray on this machine whose files are in `folder`."""
    settings = {"include_dashboard": False, "object_store_memory": OBJECT_STORE_BYTES, "_temp_dir": str(folder / "ray")}
    for left in reversed(range(STARTS)):
        try:
            ray.init("local", num_cpus=cores, num_gpus=gpus, **settings, **QUIET)
            return
        except Exception as error:  # Ray has no class for a start that takes too long
            ray.shutdown()
            kill_processes_of(folder)
            if left:
                continue
            reason = " ".join(str(error).split())
            raise ConfigError(
                f"Ray does not start on this machine ({reason}); if it is the place for temporary files, set TMPDIR "
                "to a short folder with room that you can write to."
            ) from error


def _join(address: str) -> None:
    """Join the cluster at an address."""
    host, _, port = address.rpartition(":")
    try:
        if port.isdigit():  # Ray would try for minutes
            socket.create_connection((host, int(port)), CONNECTION_SECONDS).close()
        check_token_of_cluster(address)
        with asking_once():
            ray.init(address=address, **QUIET)
    except (OSError, RuntimeError, ValueError, RayError) as error:
        if isinstance(error, ConfigError):
            raise
        reason = " ".join(str(error).split())
        raise ConfigError(
            f"--address {address}: no Ray cluster there that this machine can join ({reason}); start one with "
            "`ray start --head`, on every machine from the same environment and with the same token, and run this on "
            "one of them."
        ) from error


class RayPool:
    """A `Pool` that trains as many jobs at once as there are cores, each in a process of its own.

    Args:
        study: The study.
        problem: Scene, task and samples; sent to every node once.
        folder: Folder of Ray's own files, which are not read again; on a cluster, on the storage that all nodes share.
        gpus: GPUs of this machine that trainings share by Ray; 0 where they need none, or name the one they take.
    """

    def __init__(self, study: StudyConfig, problem: Problem, folder: Path, gpus: int = 0):
        self._study, self._folder, self._gpus = study, folder, gpus
        self._shared = ray.put((study, problem))

    @property
    def concurrency(self) -> int:
        """Number of trainings at the same time: that of the study, or else of the cores of the pool."""
        return self._study.search.concurrency or sum(_cores_by_node())

    @property
    def concurrency_of_a_node(self) -> int:
        """Number of trainings at the same time that share the memory of a node."""
        return min(self.concurrency, max(_cores_by_node()))

    @property
    def _gpu_share(self) -> float:
        """Part of a GPU that a training takes: as the study says, or such that all trainings at once find room."""
        at_once = -(-self.concurrency // self._gpus)
        return self._study.search.gpu_share or 1 / at_once

    def run(self, queue: TrialQueue, stage: str, training: TrainingConfig) -> None:
        """Train every job of a queue to the full budget of `training`, unless it is stopped before.

        Raises:
            ConfigError: If the disk is full; the records stay, and the stage can be resumed.
        """
        shared, cache = self._shared, training.cache_megabytes // self.concurrency_of_a_node
        update = {"cache_megabytes": cache, "device": self._study.training.device}
        training = training.model_copy(update=update)
        resources = {"cpu": 1, "gpu": self._gpu_share} if self._gpus else {"cpu": 1}

        def trainable(config: dict) -> None:
            _train_and_report(config["job"], stage, training, *ray.get(shared))

        driver = _Driver(queue, stage)
        tuner = tune.Tuner(
            tune.with_resources(trainable, resources),
            tune_config=tune.TuneConfig(
                num_samples=-1,
                max_concurrent_trials=self.concurrency,
                reuse_actors=True,
                trial_name_creator=lambda trial: trial.config["job"].name,
                trial_dirname_creator=lambda trial: trial.trial_id,
                search_alg=_Jobs(driver),
                scheduler=_Judge(driver),
            ),
            run_config=tune.RunConfig(
                name=stage,
                storage_path=str(self._folder),
                callbacks=[driver],
                failure_config=tune.FailureConfig(max_failures=RESTARTS),
                progress_reporter=_Silent(),
                verbose=0,
            ),
        )
        try:
            tuner.fit()
        except Exception as error:
            raise driver.error or error from None
        if driver.error:
            raise driver.error


def _place(study: StudyConfig) -> tuple[str, int]:
    """Wish for a device that a training has in its own process, and the GPUs that Ray shares out among trainings.

    Ray shows each process only its GPU, which is then the first one. A GPU that the study names is taken as it is.
    """
    device = device_of(study)
    if device.type != "cuda" or study.training.device.startswith("cuda:"):
        return str(device), 0
    return "cuda", torch.cuda.device_count()


def _with_wish(study: StudyConfig, wish: str) -> StudyConfig:
    return study.model_copy(update={"training": study.training.model_copy(update={"device": wish})})


def _cores_by_node() -> list[int]:
    return [max(int(node["Resources"].get("CPU", 1)), 1) for node in ray.nodes() if node["Alive"]]


class _NeverRestored:
    """An object that Ray may pickle without its state: Ray would restore a run from it, which we never do."""

    def __getstate__(self) -> dict:
        return {}


class _Driver(_NeverRestored, tune.Callback):
    """The connection between Ray and the queue, until an error of the queue ends the run.

    Ray keeps only the text of such an error, and may report further trials while it stops.
    """

    def __init__(self, queue: TrialQueue, stage: str):
        self._queue, self._stage = queue, stage
        self.error: Exception | None = None

    @contextmanager
    def _ends_the_run(self) -> Iterator[TrialQueue]:
        if self.error is not None:
            raise self.error
        try:
            yield self._queue
        except Exception as error:
            self.error = error
            raise

    def next(self) -> Job | None:
        """Return the next job; None if there is none left."""
        with self._ends_the_run() as queue:
            return queue.next()

    def goes_on(self, trial: "RayTrial", result: dict) -> bool:
        """Tell whether a trial continues after a report; one with an outcome ends by itself."""
        with self._ends_the_run() as queue:
            return result["outcome"] is not None or queue.on_result(str(trial), result)

    def on_trial_complete(self, iteration: int, trials: list["RayTrial"], trial: "RayTrial", **info: object) -> None:
        """Record the outcome of a training that ended by itself or was stopped after its last evaluation."""
        last = trial.last_result
        with self._ends_the_run() as queue:
            if last["outcome"] == DISK_FULL:
                raise disk_is_full(trial.config["job"], last["reason"])
            queue.on_end(str(trial), last["outcome"] or queue.outcome_after(last), last["reason"])

    def on_trial_error(self, iteration: int, trials: list["RayTrial"], trial: "RayTrial", **info: object) -> None:
        """Record that the process or node of a training died too often."""
        with self._ends_the_run() as queue:
            record_what_failed(trial.config["job"], self._stage)
            queue.on_end(str(trial), "failed", f"its process or node died {RESTARTS + 1} times")


class _Jobs(_NeverRestored, Searcher):
    """The source of jobs for Ray, which takes them from a queue."""

    def __init__(self, driver: _Driver):
        super().__init__()
        self._driver = driver

    def suggest(self, trial_id: str) -> dict | str:
        """Return the next job; Ray asks when a core is free."""
        job = self._driver.next()
        return Searcher.FINISHED if job is None else {"job": job}

    def on_trial_complete(self, trial_id: str, result: dict | None = None, error: bool = False) -> None:
        """Do nothing: the driver tells the queue."""

    def save(self, checkpoint_path: str) -> None:
        """Do nothing: a run is resumed from the records."""


class _Judge(_NeverRestored, FIFOScheduler):
    """The scheduler of Ray, which stops a trial if the queue decides so."""

    def __init__(self, driver: _Driver):
        super().__init__()
        self._driver = driver

    def on_trial_result(self, tune_controller: "TuneController", trial: "RayTrial", result: dict) -> str:
        """Ask the queue whether the trial continues."""
        return TrialScheduler.CONTINUE if self._driver.goes_on(trial, result) else TrialScheduler.STOP


class _Silent(tune.ProgressReporter):
    """A reporter that prints nothing."""

    def should_report(self, trials, done=False):
        return False

    def report(self, trials, done, *sys_info):
        return None


def _train_and_report(job: Job, stage: str, training: TrainingConfig, study: StudyConfig, problem: Problem) -> None:
    """Train a job in a process of Ray and pass every report to Ray."""
    torch.set_num_threads(1)
    for report in train_recorded(job, stage, training, study, problem):
        tune.report(report.entry | {"outcome": report.outcome, "reason": report.reason})
