"""The whole study: one stage after another, each from the records of those before it, each where it was left."""

import time
import uuid
from collections.abc import Iterator
from contextlib import AbstractContextManager, ExitStack, contextmanager, nullcontext
from functools import cache
from typing import cast

import torch

from cconv.data.dataset import Dataset
from cconv.data.plausibility import dataset_findings, refuse_nonsense
from cconv.devices import name_of
from cconv.errors import ConfigError
from cconv.study.declared.configuration import feature_path
from cconv.study.declared.domains import SearchSpace, fixed
from cconv.study.declared.search_space import check_baseline_affordable, longest_history, may_add_force
from cconv.study.declared.stage import Stage, Trials, readers_of
from cconv.study.declared.study_file import StudyConfig
from cconv.study.records.environment import describe_environment
from cconv.study.records.found import Found
from cconv.study.records.run_folder import FORMAT, RunFolder
from cconv.study.records.summary import Summary
from cconv.study.running.counted_costs import CostCounter
from cconv.study.running.observer import Observer
from cconv.study.running.optuna_mirror import OptunaMirror, database_answers, open_mirror
from cconv.study.running.pool import Pool
from cconv.study.running.predictor import with_predictor
from cconv.study.running.private_folder import remove_left_behind
from cconv.study.running.problem import (
    Problem,
    check_test_split,
    device_of,
    load_problem,
    open_study_data,
    study_task,
    with_data_path,
    with_device,
)
from cconv.study.running.serial_pool import SerialPool
from cconv.study.running.training_logs import check_loggers
from cconv.study.stages.search import SearchStage
from cconv.study.stages.session import Progress, Session
from cconv.study.studies import recorded_space, recorded_study
from cconv.tasks.external_force import force_to_add
from cconv.tasks.features import WALLS
from cconv.tasks.plausibility import target_findings
from cconv.validation import check_setting

RAY_FILES, PREDICTOR = "ray", "predictor"  # folders in that of the run


def begin_study(study: StudyConfig, space: SearchSpace, run: RunFolder) -> None:
    """Write what a run is about into its fresh folder; study.json last, by which a reader knows that there is a run."""
    run.write("space.json", space.model_dump(mode="json"))
    run.set_state("running", "data")
    write_study(run, study)


def run_study(
    run: RunFolder,
    observer: Observer,
    progress: Progress = lambda items, _: items,
    *,
    address: str | None = None,
    storage: str | None = None,
    serial: bool = False,
) -> Summary | None:
    """Run the stages of a study that have not come to their end; every result is on disk before the next begins.

    Args:
        run: Folder of a study that `begin_study` wrote.
        observer: Sees the trials as they run.
        progress: Wraps an iterable to show progress, given a label.
        address: A Ray cluster; None for this machine.
        storage: Database of the Optuna study; None for a journal file in the folder.
        serial: Whether to train one configuration after another in this process, without Ray.

    Returns:
        The summary; None if no stage selects.

    Raises:
        ConfigError: If another run works in the folder, a logger is not installed, or a stage cannot go on.
        DataError: If the data or records cannot be read.
    """
    stage = "data"
    with run.locked():
        run.remove_half_written()
        remove_left_behind(run.path / RAY_FILES)
        try:
            study, space = recorded_study(run), recorded_space(run)
            check_loggers(study.log)
            run.set_state("running", stage)
            with _session(study, space, run, observer, progress, address, storage, serial) as session:
                for stage, settings in study.stages.items():
                    if not run.has_result(stage):
                        run.set_state("running", stage)
                        _run_stage(session, stage, settings)
        except BaseException as error:
            run.set_state("interrupted" if isinstance(error, KeyboardInterrupt) else "failed", stage)
            raise
        run.set_state("finished", stage)
    return run.summary() if run.has_summary else None


def extend_study(run: RunFolder, stage: str, trials: int) -> None:
    """Give a search more trials; the stages that read it are to be run again, on the trainings that they have already.

    Raises:
        ConfigError: If the study has no such search, or another run works in the folder.
    """
    with run.locked():
        study = recorded_study(run)
        settings = study.stages.get(stage)
        if not isinstance(settings, SearchStage):
            searches = [name for name, each in study.stages.items() if isinstance(each, SearchStage)]
            raise ConfigError(f"{run.path}: no search {stage!r} to extend; searches: {', '.join(searches) or 'none'}.")
        check_setting(Trials, settings.trials + trials, "--trials, with those of the study")
        extended = settings.model_copy(update={"trials": settings.trials + trials})
        study = study.model_copy(update={"stages": study.stages | {stage: extended}})
        write_study(run, study)
        for name in {stage, *readers_of(study.stages, stage)}:
            run.forget_result(name)
        run.set_state("interrupted", stage)


def move_data(run: RunFolder, path: str) -> None:
    """Let a run read its data from another place.

    Raises:
        ConfigError: If another run works in the folder.
    """
    with run.locked():
        study = with_data_path(recorded_study(run), path)
        write_study(run, study)


def change_device(run: RunFolder, wish: str) -> None:
    """Let a run go on on another device.

    Raises:
        ConfigError: If this machine does not have it, or another run works in the folder.
    """
    with run.locked():
        write_study(run, with_device(recorded_study(run), wish))


def write_study(run: RunFolder, study: StudyConfig) -> None:
    """Write study.json, with an id that tells the run from others of the same name in a database."""
    written = run.read("study.json") if (run.path / "study.json").is_file() else {"id": uuid.uuid4().hex[:8]}
    run.write("study.json", {"format": FORMAT, "id": written["id"], **study.model_dump(mode="json")})


def _run_stage(session: Session, name: str, stage: Stage) -> None:
    start = time.perf_counter()
    found = cast(Found, stage.run(session, name))  # declarations know no records
    session.run.write_result(name, stage.kind, time.perf_counter() - start, found)


@contextmanager
def _session(
    study: StudyConfig,
    space: SearchSpace,
    run: RunFolder,
    observer: Observer,
    progress: Progress,
    address: str | None,
    storage_url: str | None,
    serial: bool,
) -> Iterator[Session]:
    """Everything that the stages share; Ray starts when the first of them trains, and ends with the session."""
    device = device_of(study)
    dataset = _described_data(study, run, observer, progress, 1 if serial else study.concurrency, device)
    task = study_task(study, dataset.scene, longest_history(space, study))
    check_test_split(study, dataset, task)
    if may_add_force(space, study):
        force_to_add(dataset.scene)
    problem = load_problem(study, dataset, task, progress)
    refuse_nonsense(target_findings(problem.typical_samples, task, stops=True))
    problem = with_predictor(problem, study, run.path / PREDICTOR, progress)
    for name in problem.task.optional:
        if name not in problem.present_features or (name == WALLS and not dataset.scene.has_boundary):
            space = fixed(space, feature_path(name))  # nothing to search, e.g. where there are no walls
    count_cost = CostCounter(study, problem)
    check_baseline_affordable(space, count_cost)
    with ExitStack() as stack:
        stack.enter_context(database_answers(storage_url))
        start_pool = cache(lambda: stack.enter_context(_pool(study, problem, run, address, serial)))
        if address is not None:
            start_pool()  # a cluster that is not there is told before anything is computed
        mirror = _mirror(study, space, run, storage_url)
        stack.callback(mirror.end_running)
        yield Session(
            study=study,
            space=space,
            dataset=dataset,
            problem=problem,
            run=run,
            observer=observer,
            mirror=mirror,
            start_pool=start_pool,
            count_cost=count_cost,
            progress=progress,
            device=device,
            useless_error=problem.objective.of_mean_predictor(problem.valid_samples, problem.typical_samples),
        )


def _described_data(
    study: StudyConfig, run: RunFolder, observer: Observer, progress: Progress, workers: int, device: torch.device
) -> Dataset:
    """The data of a study; findings about them are told, and recorded with all else that a run depends on.

    Raises:
        DataError: If the data make no sense.
    """
    dataset = open_study_data(study.data, study.seeds.data)
    findings = dataset_findings(dataset, progress)
    refuse_nonsense(findings)
    observer.on_data([str(finding) for finding in findings])
    described = describe_environment(study, dataset, workers, name_of(device))
    run.write("environment.json", described | {"data_findings": [finding.as_dict() for finding in findings]})
    return dataset


def _mirror(study: StudyConfig, space: SearchSpace, run: RunFolder, storage_url: str | None) -> OptunaMirror:
    """The searches in Optuna's storage, as far as they have come."""
    searches = [name for name, stage in study.stages.items() if isinstance(stage, SearchStage)]
    records = [record for record in run.trials() if record.stage in searches]
    name = study.name if storage_url is None else f"{study.name}-{run.read('study.json')['id']}"
    return open_mirror(run.path / "optuna.journal", storage_url, name, space, study.training.updates, records)


def _pool(
    study: StudyConfig, problem: Problem, run: RunFolder, address: str | None, serial: bool
) -> AbstractContextManager[Pool]:
    if serial:
        return nullcontext(SerialPool(study, problem))
    from cconv.study.running.ray_pool import ray_pool  # a serial study runs where there is no Ray

    return ray_pool(study, problem, run.path / RAY_FILES, address)
