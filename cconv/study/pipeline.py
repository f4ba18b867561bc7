"""The whole study: random search, adaptive search, finalists, summary."""

import time
from collections import Counter
from collections.abc import Callable, Iterable, Sequence

from cconv.data.dataset import Dataset
from cconv.errors import ConfigError
from cconv.evaluation.cost import flops_per_particle, measure_costs
from cconv.study.config import StudyConfig, TrainingConfig
from cconv.study.environment import describe_environment
from cconv.study.finalists import (
    BASELINE,
    Finalist,
    best_valid_error,
    checkpoint_of,
    evaluate_finalist,
    finalist_entry,
    finalist_jobs,
    finished_retrainings,
)
from cconv.study.observer import Observer
from cconv.study.problem import Problem, load_problem, open_study_data, study_samples
from cconv.study.records import OUTCOMES, RunFolder, TrialRecord
from cconv.study.search import adaptive_search, random_search, ray_session, run_jobs
from cconv.study.selection import choose_finalists, pareto_front, recommend
from cconv.study.space import SearchSpace, configure
from cconv.training.checkpoint import load_model, read_card, save_model

Progress = Callable[[Iterable, str], Iterable]


def run_study(
    study: StudyConfig,
    space: SearchSpace,
    run: RunFolder,
    observer: Observer,
    progress: Progress = lambda items, _: items,
) -> dict:
    """Run all stages of a study; every result is on disk before the next begins.

    Args:
        study: The study, with its data path.
        space: Its search space.
        run: A fresh run folder.
        observer: Sees the trials as they run.
        progress: Wraps an iterable to show progress, given a label.

    Returns:
        The summary, as it stands in summary.json.

    Raises:
        ConfigError: If no trial reached the full budget.
        DataError: If the data cannot be read.
    """
    start = time.perf_counter()
    run.write("study.json", study.model_dump(mode="json"))
    run.write("space.json", space.model_dump(mode="json"))
    stage = "data"
    try:
        run.set_state("running", stage)
        dataset = open_study_data(study.data, study.seeds.data)
        run.write("environment.json", describe_environment(study, dataset))
        problem = load_problem(study, dataset, progress)
        for stage in _stages(study, space, problem, run, observer):
            run.set_state("running", stage)
        stage = "summary"
        run.set_state("running", stage)
        summary = _summarize(study, dataset, problem, run, progress)
    except BaseException as error:
        run.set_state("interrupted" if isinstance(error, KeyboardInterrupt) else "failed", stage)
        raise
    summary["wall_seconds"] = time.perf_counter() - start
    run.write("summary.json", summary)
    run.set_state("finished", stage)
    return summary


def _stages(
    study: StudyConfig, space: SearchSpace, problem: Problem, run: RunFolder, observer: Observer
) -> Iterable[str]:
    """Run the trainings of a study; yields the name of each stage before it begins."""
    with ray_session(study.concurrency) as storage:
        yield "random"
        random_search(study, space, problem, run, storage, observer)
        if study.search.adaptive_trials:
            yield "adaptive"
            adaptive_search(study, space, problem, run, storage, observer)
        yield "finalists"
        finalists = [Finalist(id=BASELINE, parameters=space.baseline), *_finalists(study, space, problem, run)]
        jobs = finalist_jobs(finalists, study.finalists.seeds, study.seeds.init + 1, run)
        run_jobs(jobs, "finalists", study, finalist_training(study), problem, storage, observer)


def finalist_training(study: StudyConfig) -> TrainingConfig:
    """Training settings of the finalists: the search's, with their own budget."""
    return study.training.model_copy(update={"updates": study.finalists.updates or study.training.updates})


def _finalists(study: StudyConfig, space: SearchSpace, problem: Problem, run: RunFolder) -> list[Finalist]:
    records = [record for record in run.trials() if record.parameters != space.baseline]
    cost = {record.id: _flops(record, study, problem) for record in records}
    chosen = choose_finalists(records, cost, study.finalists.count)
    if not chosen:
        raise ConfigError(
            f"{run.path}: no trial reached the full budget of {study.training.updates} updates; "
            "add random trials or lower search.grace_updates."
        )
    return [Finalist(id=record.id, parameters=record.parameters) for record in chosen]


def _flops(record: TrialRecord, study: StudyConfig, problem: Problem) -> float:
    network, _ = configure(record.parameters, study.network, study.training)
    return flops_per_particle(problem.build_model(network, 0), problem.valid_samples[0].inputs)


def _summarize(study: StudyConfig, dataset: Dataset, problem: Problem, run: RunFolder, progress: Progress) -> dict:
    retrainings = finished_retrainings(run)
    checkpoints = {finalist: checkpoint_of(run, finalist, records) for finalist, records in retrainings.items()}
    test_samples = list(progress(study_samples(study, dataset, "test"), "test"))
    tests = {
        finalist: evaluate_finalist(run, finalist, records, test_samples, study.finalists.frames_per_block)
        for finalist, records in progress(list(retrainings.items()), "test errors")
    }
    inputs = [sample.inputs for sample in problem.valid_samples[:5]]
    costs = measure_costs(checkpoints, load_model, inputs, threads=study.cost.threads, repeats=study.cost.repeats)
    entries = [
        finalist_entry(finalist, records, tests[finalist], costs[finalist], checkpoints[finalist], run)
        for finalist, records in retrainings.items()
    ]
    for finalist, records in retrainings.items():
        _complete_cards(run, finalist, records, tests[finalist])
    chosen, reason = recommend(
        {finalist: [best_valid_error(record) for record in records] for finalist, records in retrainings.items()},
        {finalist: cost.ms_per_frame for finalist, cost in costs.items()},
    )
    return {
        "study": study.name,
        "task": study.task,
        "dataset": {
            "path": str(dataset.path),
            "scene": dataset.scene.name,
            "frames": {
                "train": len(problem.train_samples),
                "valid": len(problem.valid_samples),
                "test": len(test_samples),
            },
        },
        "baseline": BASELINE,
        "finalists": entries,
        "pareto_front": pareto_front(
            {entry["id"]: (entry["test"]["normalized_mse"], entry["cost"]["ms_per_frame"]) for entry in entries}
        ),
        "recommended": {"id": chosen, "reason": reason},
        "trials": count_outcomes(run.trials()),
    }


def _complete_cards(run: RunFolder, finalist: str, records: Sequence[TrialRecord], test: dict) -> None:
    """Add the test errors and where the model comes from to the card beside each retrained model."""
    environment = run.read("environment.json")
    for record in records:
        folder = run.path / "finalists" / finalist / record.id / "checkpoint"
        card = read_card(folder) | {
            "finalist": finalist,
            "test": {
                "normalized_mse": test["by_seed"][record.id],
                "mean_over_seeds": test["normalized_mse"],
                "ci95": test["ci95"],
            },
            "data_sha256": environment["data"]["sha256"],
            "git_commit": environment["git_commit"],
        }
        save_model(load_model(folder), folder, card)


def count_outcomes(records: Sequence[TrialRecord]) -> dict[str, dict[str, int]]:
    """Number of trials of each outcome, by stage."""
    stages = list(dict.fromkeys(record.stage for record in records))
    counts = {stage: Counter(record.outcome for record in records if record.stage == stage) for stage in stages}
    return {stage: {outcome: counts[stage][outcome] for outcome in OUTCOMES} for stage in stages}
