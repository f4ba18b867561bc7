"""Trainings side by side with Ray Tune, on this machine or on a cluster."""

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
    RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO="0",  # leave the accelerators' variables alone
    TUNE_DISABLE_SIGINT_HANDLER="1",  # Ctrl-C is ours
    TUNE_DISABLE_AUTO_CALLBACK_LOGGERS="1",  # our records are the truth
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
from cconv.study.running.problem import Problem  # noqa: E402
from cconv.study.running.recorded_training import DISK_FULL, disk_is_full, train_recorded  # noqa: E402
from cconv.study.running.trial_queue import Job, TrialQueue  # noqa: E402

if TYPE_CHECKING:  # inner names of Ray, which a release may move
    from ray.tune.execution.tune_controller import TuneController
    from ray.tune.experiment import Trial as RayTrial

QUIET = {"log_to_driver": False, "logging_level": "CRITICAL"}  # what fails is in our records
OBJECT_STORE_BYTES = 2**30
STARTS = 3  # of a Ray of our own; on a busy machine it may take longer than the 30 seconds that it gives itself
CONNECTION_SECONDS = 5.0
RESTARTS = 2  # of a training whose process or node died; it goes on from its last evaluation


@contextmanager
def ray_pool(study: StudyConfig, problem: Problem, folder: Path, address: str | None = None) -> Iterator["RayPool"]:
    """A private Ray on this machine with a core a training, or the cluster at `address`; its files go when it ends.

    The private one listens on loopback alone and demands a token of this run; a cluster must demand the user's.

    Raises:
        ConfigError: If Ray cannot start here, or there is no cluster at the address that can be joined.
    """
    folder = folder.absolute()
    with ExitStack() as stack:
        stack.callback(shutil.rmtree, folder, ignore_errors=True)
        demand_tokens()
        if address is None:
            own = stack.enter_context(private_folder())
            stack.enter_context(token_of_this_run(own))
            stack.enter_context(on_loopback_alone())
        stack.callback(ray.shutdown)
        _start(study.concurrency, own) if address is None else _join(address)
        ray._private.worker._worker_logs_enabled = False  # our records say what died
        yield RayPool(study, problem, folder)


def _start(cores: int, folder: Path) -> None:
    """Start a Ray on this machine whose files are in `folder`."""
    settings = {"include_dashboard": False, "object_store_memory": OBJECT_STORE_BYTES, "_temp_dir": str(folder / "ray")}
    for left in reversed(range(STARTS)):
        try:
            ray.init("local", num_cpus=cores, **settings, **QUIET)
            return
        except Exception as error:  # of no kind of its own where it took too long
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
    host, _, port = address.rpartition(":")
    try:
        if port.isdigit():  # Ray itself would try for minutes
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
        problem: What all trainings share; sent to every node once.
        folder: Ray's own files, which nothing of ours reads; on a cluster on the storage that all nodes share.
    """

    def __init__(self, study: StudyConfig, problem: Problem, folder: Path):
        self._study, self._folder = study, folder
        self._shared = ray.put((study, problem))

    @property
    def concurrency(self) -> int:
        """Trainings at once: as many as the pool has cores, unless the study says otherwise."""
        return self._study.search.concurrency or sum(_cores_by_node())

    @property
    def concurrency_of_a_node(self) -> int:
        """Trainings at once that share the memory of a node."""
        return min(self.concurrency, max(_cores_by_node()))

    def run(self, queue: TrialQueue, stage: str, training: TrainingConfig) -> None:
        """Train every job of a queue that does not stop earlier to the full budget of `training`.

        Raises:
            ConfigError: If the disk is full; what was recorded stays, and the stage can be resumed.
        """
        shared, cache = self._shared, training.cache_megabytes // self.concurrency_of_a_node
        training = training.model_copy(update={"cache_megabytes": cache})

        def trainable(config: dict) -> None:
            _train_and_report(config["job"], stage, training, *ray.get(shared))

        driver = _Driver(queue)
        tuner = tune.Tuner(
            tune.with_resources(trainable, {"cpu": 1}),
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


def _cores_by_node() -> list[int]:
    return [max(int(node["Resources"].get("CPU", 1)), 1) for node in ray.nodes() if node["Alive"]]


class _NeverRestored:
    """Ray pickles what drives a run in order to restore it from its own files, which we never do."""

    def __getstate__(self) -> dict:
        return {}


class _Driver(_NeverRestored, tune.Callback):
    """Passes on what Ray and the queue have to say to each other, until an error of the queue ends the run.

    Ray keeps no more of such an error than its text, and may speak of further trials while it gives up.
    """

    def __init__(self, queue: TrialQueue):
        self._queue = queue
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
        """The next job."""
        with self._ends_the_run() as queue:
            return queue.next()

    def goes_on(self, trial: "RayTrial", result: dict) -> bool:
        """Whether a trial goes on after an evaluation; a last word of the training is none."""
        with self._ends_the_run() as queue:
            return result["outcome"] is not None or queue.on_result(str(trial), result)

    def on_trial_complete(self, iteration: int, trials: list["RayTrial"], trial: "RayTrial", **info: object) -> None:
        """A training said how it ended, or was stopped after its last evaluation."""
        last = trial.last_result
        with self._ends_the_run() as queue:
            if last["outcome"] == DISK_FULL:
                raise disk_is_full(trial.config["job"], last["reason"])
            queue.on_end(str(trial), last["outcome"] or queue.outcome_after(last), last["reason"])

    def on_trial_error(self, iteration: int, trials: list["RayTrial"], trial: "RayTrial", **info: object) -> None:
        """The training's process or node died too often."""
        with self._ends_the_run() as queue:
            queue.on_end(str(trial), "failed", f"its process or node died {RESTARTS + 1} times")


class _Jobs(_NeverRestored, Searcher):
    """Hands the jobs of a queue to Ray."""

    def __init__(self, driver: _Driver):
        super().__init__()
        self._driver = driver

    def suggest(self, trial_id: str) -> dict | str:
        """The next job, when a place is free."""
        job = self._driver.next()
        return Searcher.FINISHED if job is None else {"job": job}

    def on_trial_complete(self, trial_id: str, result: dict | None = None, error: bool = False) -> None:
        """Nothing: the queue hears it from the driver."""

    def save(self, checkpoint_path: str) -> None:
        """Nothing: the records are what a run is resumed from."""


class _Judge(_NeverRestored, FIFOScheduler):
    """Stops a trial when the queue says so."""

    def __init__(self, driver: _Driver):
        super().__init__()
        self._driver = driver

    def on_trial_result(self, tune_controller: "TuneController", trial: "RayTrial", result: dict) -> str:
        """Ask the queue."""
        return TrialScheduler.CONTINUE if self._driver.goes_on(trial, result) else TrialScheduler.STOP


class _Silent(tune.ProgressReporter):
    def should_report(self, trials, done=False):
        return False

    def report(self, trials, done, *sys_info):
        return None


def _train_and_report(job: Job, stage: str, training: TrainingConfig, study: StudyConfig, problem: Problem) -> None:
    """Train a job in a process of Ray, and tell Ray every report."""
    torch.set_num_threads(1)
    for report in train_recorded(job, stage, training, study, problem):
        tune.report(report.entry | {"outcome": report.outcome, "reason": report.reason})
