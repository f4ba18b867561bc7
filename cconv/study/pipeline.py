"""The whole study: closed forms, initialisation, random search, adaptive search, finalists, summary."""

import time
from collections import Counter
from collections.abc import Callable, Iterable, Sequence

from cconv.data.dataset import Dataset
from cconv.errors import ConfigError
from cconv.evaluation.cost import measure_costs
from cconv.evaluation.stability import measure_stability
from cconv.study.closed_form import fit_closed_form_finalists, flops_of, screen_closed_forms
from cconv.study.config import StudyConfig, TrainingConfig
from cconv.study.environment import describe_environment
from cconv.study.finalists import (
    BASELINE,
    Finalist,
    complete_cards,
    evaluate_finalist,
    finalist_entry,
    finalist_jobs,
    retrained_finalists,
)
from cconv.study.initialization import train_many_seeds, variance_decomposition
from cconv.study.observer import Observer
from cconv.study.problem import load_problem, open_study_data, study_samples
from cconv.study.records import OUTCOMES, RunFolder, TrialRecord
from cconv.study.search import Session, adaptive_search, random_search, ray_session, run_jobs
from cconv.study.selection import choose_finalists, pareto_front, recommend
from cconv.study.space import SearchSpace
from cconv.training.checkpoint import load_model

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
        ConfigError: If no finalist could be retrained.
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
        session = Session(study=study, space=space, problem=problem, run=run, observer=observer)
        for stage in _stages(session, progress):
            run.set_state("running", stage)
        stage = "summary"
        run.set_state("running", stage)
        summary = _summarize(session, dataset, progress)
    except BaseException as error:
        run.set_state("interrupted" if isinstance(error, KeyboardInterrupt) else "failed", stage)
        raise
    summary["wall_seconds"] = time.perf_counter() - start
    run.write("summary.json", summary)
    run.set_state("finished", stage)
    return summary


def _stages(session: Session, progress: Progress) -> Iterable[str]:
    """Run the trainings of a study; yields the name of each stage before it begins."""
    study, run = session.study, session.run
    if study.closed_form is not None:
        yield "closed_form"
        screen_closed_forms(study, session.space, session.problem, run, progress)
        fit_closed_form_finalists(study, session.problem, run, progress)
    with ray_session(session):
        if study.initialization is not None:
            yield "initialization"
            train_many_seeds(session)
        yield "random"
        random_search(session)
        if study.search.adaptive_trials:
            yield "adaptive"
            adaptive_search(session)
        yield "finalists"
        finalists = [Finalist(id=BASELINE, parameters=session.space.baseline), *_challengers(session)]
        jobs = finalist_jobs(finalists, study.finalists.seeds, study.seeds.init + 1, run)
        run_jobs(session, jobs, "finalists", finalist_training(study))


def finalist_training(study: StudyConfig) -> TrainingConfig:
    """Training settings of the finalists: the search's, with their own budget."""
    return study.training.model_copy(update={"updates": study.finalists.updates or study.training.updates})


def _challengers(session: Session) -> list[Finalist]:
    """The configurations that challenge the baseline; none where only the baseline reached the full budget."""
    baseline, records = session.space.baseline, session.run.trials()
    trained = [record for record in records if not record.is_closed_form and record.parameters != baseline]
    completed = [record for record in trained if record.outcome == "completed"]
    cost = {record.id: flops_of(record, session.study, session.problem) for record in completed}
    chosen = choose_finalists(completed, cost, session.study.finalists.count)
    return [Finalist(id=record.id, parameters=record.parameters) for record in chosen]


def _summarize(session: Session, dataset: Dataset, progress: Progress) -> dict:
    study, problem, run = session.study, session.problem, session.run
    finalists, failed = retrained_finalists(run, study.finalists.seeds)
    if not finalists:
        ends = ". ".join(f"{finalist}: {end}" for finalist, end in failed.items())
        raise ConfigError(f"{run.path}: no finalist finished its training ({ends}); see trials/ and finalists/ there.")
    test_samples = list(progress(study_samples(study, dataset, "test"), "test"))
    tests = {
        finalist.id: evaluate_finalist(finalist, test_samples, study.finalists.frames_per_block)
        for finalist in progress(finalists, "test errors")
    }
    inputs = [sample.inputs for sample in problem.valid_samples[:5]]
    checkpoints = {finalist.id: finalist.best_checkpoint for finalist in finalists}
    costs = measure_costs(checkpoints, load_model, inputs, threads=study.cost.threads, repeats=study.cost.repeats)
    trajectories = list(dataset.trajectories("valid"))  # stability decides, and the test split must not
    stability = {
        finalist.id: measure_stability(load_model(finalist.best_checkpoint), trajectories, dataset.scene)
        for finalist in progress(finalists, "stability")
    }
    environment = run.read("environment.json")
    for finalist in finalists:
        complete_cards(finalist, tests[finalist.id], environment)
    chosen, reason = recommend(
        {finalist.id: finalist.valid_errors for finalist in finalists},
        {finalist.id: costs[finalist.id].ms_per_frame for finalist in finalists},
        study.selection.accurate_enough,
        unstable=[finalist for finalist, checks in stability.items() if not checks["stable"]],
    )
    frames = {"train": len(problem.train_samples), "valid": len(problem.valid_samples), "test": len(test_samples)}
    retrainings = [record for records in run.retrainings().values() for record in records]
    return {
        "study": study.name,
        "task": study.task,
        "dataset": {"path": str(dataset.path), "scene": dataset.scene.name, "frames": frames},
        "baseline": BASELINE,
        "finalists": [
            finalist_entry(each, tests[each.id], costs[each.id], stability[each.id], run) for each in finalists
        ],
        "failed_finalists": failed,
        "pareto_front": pareto_front(
            {each.id: (tests[each.id]["normalized_mse"], costs[each.id].ms_per_frame) for each in finalists}
        ),
        "recommended": {"id": chosen, "reason": reason},
        "initialization": variance_decomposition(run),
        "trials": count_outcomes([*run.trials(), *retrainings]),
    }


def count_outcomes(records: Sequence[TrialRecord]) -> dict[str, dict[str, int]]:
    """Number of trials of each outcome, by stage."""
    stages = list(dict.fromkeys(record.stage for record in records))
    counts = {stage: Counter(record.outcome for record in records if record.stage == stage) for stage in stages}
    return {stage: {outcome: counts[stage][outcome] for outcome in OUTCOMES} for stage in stages}
