"""The select stage recommends a finalist by validation error, time and stability, tests all, and writes the summary."""

import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import islice
from pathlib import Path
from typing import Any, Literal

import numpy as np

from cconv.data.splits import evenly_spaced
from cconv.data.stored_frames import StoredFrames
from cconv.evaluation.checks.stability import measure_stability
from cconv.evaluation.cost import Cost, measure_costs, measure_growth
from cconv.evaluation.explanation import error_distribution, explain
from cconv.models.checkpoint import load_model
from cconv.models.model import Model
from cconv.study.declared.stage import BASELINE, Stage, reads_of
from cconv.study.evidence.budget import budget_words
from cconv.study.evidence.front import Timing, attainment, hypervolume_interval, timed_front
from cconv.study.evidence.recommendation import Recommendation, recommend, retrained_error
from cconv.study.records.found import Found, Parts
from cconv.study.records.run_folder import RunFolder
from cconv.study.records.rungs import RungFile
from cconv.study.records.summary import (
    AnalyticCost,
    ComparedModel,
    DatasetFacts,
    Errors,
    FinalistEntry,
    Front,
    Growth,
    MeanPredictor,
    PassedRung,
    Recommended,
    Selection,
    SizeTime,
    SolverComparison,
    Stability,
    Summary,
    TaskFacts,
)
from cconv.study.records.trials import count_outcomes
from cconv.study.running.counted_costs import points_of_search
from cconv.study.running.problem import study_samples
from cconv.study.stages.checked import stability_checks
from cconv.study.stages.finalists import (
    Retrained,
    check_any_finished,
    complete_cards,
    evaluate_finalist,
    finalist_entry,
    retrained_finalists,
)
from cconv.study.stages.rolled import record_rollouts
from cconv.study.stages.session import Session
from cconv.study.stages.solver import compare_with_solver
from cconv.tasks.samples import Sample, WindowSamples
from cconv.tasks.task import FieldTask

TIMED_FRAMES = 5
GROWTH_REPEATS = 3


class SelectStage(Stage):
    """Compare the finalists, recommend one, then test all of them."""

    kind: Literal["select"] = "select"
    is_single = True
    uses = ("finalists", "converge")
    needs_records = True

    def run(self, session: Session, name: str) -> Found:
        """Choose a finalist by validation errors, time and stability; then read the test split, once.

        Write summary.json and return the id of the chosen finalist.

        Raises:
            StudyError: If no finalist could be retrained.
        """
        summary = _summary(session, name, time.perf_counter())
        session.run.write_summary(summary)
        return Found(recommended=summary.recommended.id)


def _summary(session: Session, stage: str, start: float) -> Summary:
    """Compare, test and explain the finalists; `start` is the performance counter at the beginning of the stage."""
    study, run = session.study, session.run
    finalists, failed = _finalists(session, stage)
    check_any_finished(run, finalists, failed)
    judged = _judge(session, finalists)
    growth = _growth(session, finalists)
    samples = study_samples(study, session.dataset, "test", session.problem.task, session.progress)
    tests, test_errors = _errors(session, finalists, samples, "test errors")
    is_field = isinstance(session.problem.task, FieldTask)
    explained = [each for each in finalists if is_field and each.id in (BASELINE, judged.chosen.id)]
    _explain(run, explained, samples)
    _complete_cards(run, finalists, tests)
    mean, earlier = _mean_predictor(session, samples), _of_earlier_stages(session, stage)
    entries = [_entry(each, judged, tests[each.id], run) for each in finalists]
    points, cost_model = points_of_search(session.count_cost, run.trials(), judged.costs)
    return Summary(
        study=study.name,
        task=_task(session, samples),
        dataset=_dataset(session, samples),
        baseline=BASELINE,
        checks=judged.checks,
        mean_predictor=mean,
        finalists=entries,
        budget=budget_words(entries, earlier.convergence, study.selection.margin),
        failed_finalists=failed,
        pareto_front=timed_front({name: float(np.mean(e)) for name, e in judged.errors.items()}, judged.times),
        front=_front(test_errors, judged.times, mean.test),
        recommended=Recommended(id=judged.chosen.id, reason=judged.chosen.reason),
        selection=_selection(judged, test_errors, study.selection.margin),
        search_points=points,
        cost_model=cost_model,
        analytic=judged.analytic,
        solver=_solver(session, finalists, judged, samples),
        growth=growth,
        explained=[each.id for each in explained],
        rolled=record_rollouts(session, finalists, judged.chosen.id),
        trials=_counts(run),
        rungs=_passed_rungs(session),
        wall_seconds=_seconds_before(session, stage) + time.perf_counter() - start,
        **earlier.found(),
    )


def _complete_cards(run: RunFolder, finalists: Sequence[Retrained], tests: Mapping[str, Errors]) -> None:
    environment = run.read("environment.json")
    for finalist in finalists:
        complete_cards(finalist, tests[finalist.id], environment)


@dataclass(frozen=True, kw_only=True)
class _Judged:
    """The measurements that the choice of a finalist rests on; none uses the test split.

    Attributes:
        facts: Validation errors of each finalist.
        errors: The same errors as tables (seeds, units).
        costs: Cost of each finalist and of some trials.
        analytic: Cost of the analytic field, timed in turn with them; None for steps.
        times: Time of each finalist.
        checks: Description of each check of stability, by name.
        stability: Findings of the checks in each finalist.
        choose: Function from validation errors to a recommendation.
        chosen: The recommendation with all seeds.
    """

    facts: dict[str, Errors]
    errors: dict[str, np.ndarray]
    costs: dict[str, Cost]
    analytic: AnalyticCost | None
    times: dict[str, Timing]
    checks: dict[str, str]
    stability: dict[str, Stability]
    choose: Callable[[Mapping[str, np.ndarray]], Recommendation]
    chosen: Recommendation


def _judge(session: Session, finalists: Sequence[Retrained]) -> _Judged:
    settings = session.study.selection
    facts, errors = _errors(session, finalists, session.problem.valid_samples, "validation errors")
    (costs, analytic), (checks, stability) = _time(session, finalists), _stress(session, finalists)
    times = {name: Timing(costs[name].turns_ms) for name in facts}
    choose = partial(
        recommend,
        times=times,
        failures={name: found.failures for name, found in stability.items()},
        accurate_enough=settings.accurate_enough,
        margin=settings.margin,
    )
    return _Judged(
        facts=facts,
        errors=errors,
        costs=costs,
        analytic=analytic,
        times=times,
        checks=checks,
        stability=stability,
        choose=choose,
        chosen=choose(errors),
    )


def _entry(finalist: Retrained, judged: _Judged, test: Errors, run: RunFolder) -> FinalistEntry:
    name = finalist.id
    return finalist_entry(finalist, judged.facts[name], test, judged.costs[name], judged.stability[name], run)


def _finalists(session: Session, stage: str) -> tuple[list[Retrained], dict[str, str]]:
    ids = [each for name in reads_of(session.study.stages, stage) for each in session.run.result(name).finalists]
    return retrained_finalists(session.run, ids, session.study.finalists.seeds)


def _errors(
    session: Session, finalists: Sequence[Retrained], samples: Sequence[Sample], label: str
) -> tuple[dict[str, Errors], dict[str, np.ndarray]]:
    """Measure the errors of each finalist on a split, as facts and as tables (seeds, units)."""
    frames = session.study.finalists.frames_per_block
    both = {
        each.id: evaluate_finalist(each, session.problem.objective, samples, frames, session.load_model)
        for each in session.progress(finalists, label)
    }
    return {name: facts for name, (facts, _) in both.items()}, {name: units for name, (_, units) in both.items()}


def _mean_predictor(session: Session, test_samples: Sequence[Sample]) -> MeanPredictor:
    """Measure the error of always predicting the training mean on each split; a useful model must be well below."""
    problem, objective = session.problem, session.problem.objective
    return MeanPredictor(
        valid=objective.of_mean_predictor(problem.valid_samples, problem.typical_samples),
        test=objective.of_mean_predictor(test_samples, problem.typical_samples),
    )


def _time(session: Session, finalists: Sequence[Retrained]) -> tuple[dict[str, Cost], AnalyticCost | None]:
    """Time in turn the finalists, some trials from the cheapest to the costliest, and the analytic field."""
    settings, run, problem = session.study.cost, session.run, session.problem
    checkpoints = {finalist.id: finalist.best_checkpoint for finalist in finalists}
    trials = [record for record in run.trials() if record.last is not None and record.id not in checkpoints]
    trials.sort(key=lambda record: record.config["flops_per_particle"])
    chosen = [trials[place] for place in evenly_spaced(len(trials), settings.trials)] if trials else []
    checkpoints |= {record.id: run.trial(record.id).checkpoint for record in chosen}
    frames = _timed_frames(session)
    costs, analytic = measure_costs(
        checkpoints,
        partial(load_model, device=session.device),  # is sent to other processes
        frames,
        session.dataset.scene,
        task=problem.task,
        threads=settings.threads,
        repeats=settings.repeats,
    )
    return costs, None if analytic is None else AnalyticCost.model_validate(analytic, from_attributes=True)


def _timed_frames(session: Session) -> list[Any]:
    """Choose what models are timed on: the first validation frames, or the windows that rollouts begin with."""
    samples = session.problem.valid_samples
    if isinstance(samples, WindowSamples):
        return list(samples.windows[:TIMED_FRAMES])
    dataset = session.dataset
    stored = (StoredFrames(dataset, "valid", k) for k in range(len(dataset.splits["valid"])))
    return list(islice((each[index] for each in stored for index in range(len(each))), TIMED_FRAMES))


def _growth(session: Session, finalists: Sequence[Retrained]) -> Growth:
    """Time the finalists and the analytic field on blocks of fluid of growing size."""
    settings = session.study.cost
    checkpoints = {finalist.id: finalist.best_checkpoint for finalist in finalists}
    sizes = settings.sizes
    grown = measure_growth(
        checkpoints,
        session.load_model,
        analytic=load_model(finalists[0].best_checkpoint).config,
        sizes=sizes,
        threads=settings.threads,
        repeats=GROWTH_REPEATS,
    )
    return Growth(
        sizes=sizes,
        models={
            name: [SizeTime.model_validate(time, from_attributes=True) for time in growth.times]
            for name, growth in grown.items()
        },
        exponents={name: growth.exponent for name, growth in grown.items() if math.isfinite(growth.exponent)},
        left_out={name: growth.left_out for name, growth in grown.items() if growth.left_out},
    )


def _stress(session: Session, finalists: Sequence[Retrained]) -> tuple[dict[str, str], dict[str, Stability]]:
    """Run the checks of stability on every seed; return the description of each check and the findings per finalist.

    All frames come from validation trajectories; the test split is only read for its errors.
    """
    reach = max(load_model(finalist.best_checkpoint).cutoff for finalist in finalists)
    material, checks = stability_checks(session, reach)
    found = {
        finalist.id: Stability(
            **measure_stability(_of_seeds(finalist, material.predictor, session.load_model), checks, material.counts)
        )
        for finalist in session.progress(finalists, "stability")
    }
    return {check.name: check.description() for check in checks}, found


def _of_seeds(finalist: Retrained, predictor: Callable[[Model], Any], load: Callable[[Path], Model]) -> dict[str, Any]:
    """Make what checks test of every training of a finalist, by the name of the training."""
    trained = zip(finalist.records, finalist.checkpoints, strict=True)
    return {record.id: predictor(load(checkpoint)) for record, checkpoint in trained}


def _solver(
    session: Session, finalists: Sequence[Retrained], judged: _Judged, samples: Sequence[Sample]
) -> SolverComparison | None:
    """Measure the solver beside the chosen finalist of a step task."""
    if not isinstance(samples, WindowSamples):
        return None
    name = judged.chosen.id
    chosen = next(each for each in finalists if each.id == name)
    return compare_with_solver(session, chosen, judged.costs[name].ms_per_frame, samples)


def _explain(run: RunFolder, finalists: Sequence[Retrained], samples: Sequence[Sample]) -> None:
    """Save the filters, a predicted test frame and the error distribution of some finalists, for the report."""
    if not finalists:
        return
    folder = run.path / "explanation"
    folder.mkdir(exist_ok=True)
    first = [sample for sample in samples if sample.trajectory == samples[0].trajectory]
    frame = first[len(first) // 2]  # not the first, which may be at rest
    for finalist in finalists:
        model = load_model(finalist.best_checkpoint)
        arrays: dict[str, Any] = explain(model, frame) | error_distribution(model, samples)
        np.savez_compressed(folder / f"{finalist.id}.npz", **arrays)


def _selection(judged: _Judged, test_errors: Mapping[str, np.ndarray], margin: float) -> Selection:
    chosen = judged.chosen
    comparisons = [
        ComparedModel(
            id=each.id,
            error=each.error,
            ms_per_frame=each.time.ms,
            ratio=each.to_best.ratio,
            log_standard_error=each.to_best.log_standard_error,
            ci95=each.to_best.ci95,
            within_one_se=each.within_one_se,
            non_inferior=each.non_inferior,
            accurate_enough=each.accurate_enough,
            stable=each.stable,
            eligible=each.eligible,
            why_not=each.why_not,
        )
        for each in chosen.comparisons
    ]
    return Selection(
        units=next(iter(judged.errors.values())).shape[1],
        margin=margin,
        best=chosen.best,
        tied=chosen.tied,
        by_rule=chosen.by_rule,
        comparisons=comparisons,
        retrained=retrained_error(judged.errors, test_errors, lambda errors: judged.choose(errors).id),
    )


def _front(errors: Mapping[str, np.ndarray], times: Mapping[str, Timing], worst: float) -> Front:
    """Describe the front of the test errors: attainment band over seeds, and hypervolume.

    The reference point of the hypervolume is the mean predictor at the time of the slowest finalist.
    """
    milliseconds = {name: timing.ms for name, timing in times.items()}
    area = hypervolume_interval(errors, milliseconds, (worst, max(milliseconds.values())))
    return Front(attainment=attainment(errors, milliseconds), hypervolume=area)


def _task(session: Session, test_samples: Sequence[Sample]) -> TaskFacts:
    task, objective = session.problem.task, session.problem.objective
    horizon = len(test_samples.windows[0].future) if isinstance(test_samples, WindowSamples) else None
    return TaskFacts(
        name=task.name,
        symbol=task.symbol,
        meaning=task.meaning,
        error=objective.label,
        error_meaning=objective.meaning,
        measures=objective.measures,
        mean_predictor=objective.mean_predictor,
        horizon=horizon,
    )


def _dataset(session: Session, test_samples: Sequence[Sample]) -> DatasetFacts:
    problem = session.problem
    frames = {"train": len(problem.train_samples), "valid": len(problem.valid_samples), "test": len(test_samples)}
    return DatasetFacts(path=str(session.dataset.path), scene=session.dataset.scene.name, frames=frames)


def _passed_rungs(session: Session) -> dict[str, list[PassedRung]]:
    """Count how many trials of each search continued beyond each rung."""
    study, file = session.study, RungFile(session.run.path / "rungs.json")
    factor = study.search.reduction_factor
    return {stage: file.table(stage, study.rungs, factor).passed() for stage in file.read()}


def _counts(run: RunFolder) -> dict[str, dict[str, int]]:
    retrainings = [record for records in run.retrainings().values() for record in records]
    return count_outcomes([*run.trials(), *retrainings])


def _seconds_before(session: Session, stage: str) -> float:
    names = list(session.study.stages)
    return sum(session.run.result(name).seconds for name in names[: names.index(stage)])


def _of_earlier_stages(session: Session, stage: str) -> Parts:
    """Collect the parts of the summary that the stages before this one have found."""
    found: dict = {}
    names = list(session.study.stages)
    for name in names[: names.index(stage)]:
        found |= session.run.result(name).found()
    return Parts(**found)
