"""The select stage: the finalists tested, timed and stressed, one of them recommended, and the study summed up."""

import math
import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from itertools import islice

import numpy as np

from cconv.data.splits import evenly_spaced
from cconv.data.targets import Sample
from cconv.evaluation.cost import AnalyticCost, Cost, measure_costs, measure_growth
from cconv.evaluation.explanation import error_distribution, explain
from cconv.evaluation.probes import make_probes
from cconv.evaluation.stability import ModelPredictor, measure_stability
from cconv.sph.kernels import AbstractKernel, kernel_named
from cconv.study.budget import budget_words
from cconv.study.costs import points_of_search
from cconv.study.finalists import (
    Retrained,
    check_any_finished,
    complete_cards,
    evaluate_finalist,
    finalist_entry,
    retrained_finalists,
)
from cconv.study.front import attainment, bootstrap_hypervolume
from cconv.study.problem import Problem, study_samples
from cconv.study.records import RunFolder, count_outcomes
from cconv.study.selection import Recommendation, pareto_front, recommend
from cconv.study.session import Session
from cconv.study.stages import BASELINE, reads_of
from cconv.training.checkpoint import load_model

TIMED_FRAMES = 5
GROWTH_REPEATS = 3


def select(session: Session, stage: str) -> dict:
    """Test, time and stress the finalists, recommend one, write summary.json.

    Raises:
        StudyError: If no finalist could be retrained.
    """
    start = time.perf_counter()
    study, run = session.study, session.run
    finalists, failed = _finalists(session, stage)
    check_any_finished(run, finalists, failed)
    samples = list(session.progress(study_samples(study, session.dataset, "test"), "test"))
    tests, errors = _test(session, finalists, samples)
    timed, analytic = _time(session, finalists)
    costs = {finalist.id: timed[finalist.id] for finalist in finalists}
    stability = _stress(session, finalists)
    chosen = recommend(
        errors,
        {name: cost.ms_per_frame for name, cost in costs.items()},
        {name: checks["failures"] for name, checks in stability.items()},
        accurate_enough=study.selection.accurate_enough,
        margin=study.selection.margin,
    )
    _explain(run, [each for each in finalists if each.id in (BASELINE, chosen.id)], samples)
    environment = run.read("environment.json")
    for finalist in finalists:
        complete_cards(finalist, tests[finalist.id], environment)
    milliseconds = {name: cost.ms_per_frame for name, cost in costs.items()}
    entries = [finalist_entry(each, tests[each.id], costs[each.id], stability[each.id], run) for each in finalists]
    found = _of_earlier_stages(session, stage)
    summary = {
        "study": study.name,
        "task": study.task,
        "dataset": _dataset(session, samples),
        "baseline": BASELINE,
        "finalists": entries,
        "budget": budget_words(entries, found.get("convergence", {}), study.selection.margin),
        "failed_finalists": failed,
        "pareto_front": pareto_front({name: (tests[name]["normalized_mse"], milliseconds[name]) for name in tests}),
        "front": _front(errors, milliseconds),
        "recommended": {"id": chosen.id, "reason": chosen.reason},
        "selection": _selection(chosen, study.selection.margin),
        **points_of_search(session.count_cost, run.trials(), timed),
        "analytic": asdict(analytic),
        "growth": _growth(session, finalists),
        "trials": _counts(run),
        **found,
        "wall_seconds": _seconds_before(session, stage) + time.perf_counter() - start,
    }
    run.write("summary.json", summary)
    return {"recommended": chosen.id}


def _finalists(session: Session, stage: str) -> tuple[list[Retrained], dict[str, str]]:
    ids = [each for name in reads_of(session.study.stages, stage) for each in session.run.result(name)["finalists"]]
    return retrained_finalists(session.run, ids, session.study.finalists.seeds)


def _test(
    session: Session, finalists: Sequence[Retrained], samples: Sequence[Sample]
) -> tuple[dict[str, dict], dict[str, np.ndarray]]:
    """Test errors of each finalist, as facts and by (seeds, units)."""
    frames = session.study.finalists.frames_per_block
    both = {each.id: evaluate_finalist(each, samples, frames) for each in session.progress(finalists, "test errors")}
    return {name: facts for name, (facts, _) in both.items()}, {name: units for name, (_, units) in both.items()}


def _time(session: Session, finalists: Sequence[Retrained]) -> tuple[dict[str, Cost], AnalyticCost]:
    """Time of the finalists, of some trials from the cheapest to the costliest, and of the analytic field, in turn."""
    settings, run, problem = session.study.cost, session.run, session.problem
    checkpoints = {finalist.id: finalist.best_checkpoint for finalist in finalists}
    trials = [record for record in run.trials() if record.last is not None and record.id not in checkpoints]
    trials.sort(key=lambda record: record.config["flops_per_particle"])
    chosen = [trials[place] for place in evenly_spaced(len(trials), settings.trials)] if trials else []
    checkpoints |= {record.id: run.trial(record.id).checkpoint for record in chosen}
    frames = list(islice((frame for each in session.dataset.trajectories("valid") for frame in each), TIMED_FRAMES))
    return measure_costs(
        checkpoints,
        load_model,
        frames,
        session.dataset.scene,
        task=problem.task,
        kernel=_kernel(problem),
        threads=settings.threads,
        repeats=settings.repeats,
    )


def _growth(session: Session, finalists: Sequence[Retrained]) -> dict:
    """Time of the finalists and of the analytic field on blocks of fluid of growing size."""
    settings = session.study.cost
    checkpoints = {finalist.id: finalist.best_checkpoint for finalist in finalists}
    sizes = settings.sizes
    grown = measure_growth(
        checkpoints,
        load_model,
        analytic=load_model(finalists[0].best_checkpoint).config,
        sizes=sizes,
        threads=settings.threads,
        repeats=GROWTH_REPEATS,
    )
    return {
        "sizes": list(sizes),
        "models": {name: [asdict(time) for time in growth.times] for name, growth in grown.items()},
        "exponents": {name: growth.exponent for name, growth in grown.items() if math.isfinite(growth.exponent)},
        "left_out": {name: list(growth.left_out) for name, growth in grown.items() if growth.left_out},
    }


def _stress(session: Session, finalists: Sequence[Retrained]) -> dict[str, dict]:
    """Stability of every seed on validation trajectories; the test split is only looked at for its errors."""
    problem, scene = session.problem, session.dataset.scene
    trajectories = list(session.dataset.trajectories("valid"))
    reach = max(load_model(finalist.best_checkpoint).cutoff for finalist in finalists)
    probes = make_probes(trajectories, scene, problem.task, _kernel(problem), reach)
    return {
        finalist.id: measure_stability(
            {
                record.id: ModelPredictor(load_model(checkpoint))
                for record, checkpoint in zip(finalist.records, finalist.checkpoints, strict=True)
            },
            probes,
        )
        for finalist in session.progress(finalists, "stability")
    }


def _kernel(problem: Problem) -> AbstractKernel:
    return kernel_named(problem.kernel)(problem.smoothing_length, problem.scene.dim)


def _explain(run: RunFolder, finalists: Sequence[Retrained], samples: Sequence[Sample]) -> None:
    """Save filters, a predicted test frame and the distribution of errors of some finalists, for the report."""
    folder = run.path / "explanation"
    folder.mkdir(exist_ok=True)
    first = [sample for sample in samples if sample.trajectory == samples[0].trajectory]
    frame = first[len(first) // 2]  # that of the start may be at rest
    for finalist in finalists:
        model = load_model(finalist.best_checkpoint)
        arrays = explain(model, frame) | error_distribution(model, samples)
        np.savez_compressed(folder / f"{finalist.id}.npz", **arrays)


def _selection(chosen: Recommendation, margin: float) -> dict:
    comparisons = [
        {
            "id": each.id,
            "error": each.error,
            "cost": each.cost,
            "difference": each.to_best.difference,
            "standard_error": each.to_best.standard_error,
            "ci95": list(each.to_best.ci95),
            "ratio": each.to_best.ratio,
            "ratio_ci95": list(each.to_best.ratio_ci95),
            "within_one_se": each.within_one_se,
            "non_inferior": each.non_inferior,
            "accurate_enough": each.accurate_enough,
            "stable": each.stable,
            "eligible": each.eligible,
            "why_not": each.why_not,
        }
        for each in chosen.comparisons
    ]
    return {"margin": margin, "best": chosen.best, "by_rule": chosen.by_rule, "comparisons": comparisons}


def _front(errors: Mapping[str, np.ndarray], milliseconds: Mapping[str, float]) -> dict:
    """Attainment band over seeds, and the hypervolume up to predicting the mean at the cost of the slowest finalist."""
    band = attainment(errors, milliseconds)
    corner = (1.0, max(milliseconds.values()))
    area = bootstrap_hypervolume(errors, milliseconds, corner)
    steps = zip(band["cost"], band["median"], band["low"], band["high"], strict=True)
    low, high = area["ci95"]
    return {
        "attainment": [dict(zip(("ms_per_frame", "median", "low", "high"), step, strict=True)) for step in steps],
        "hypervolume": {"value": area["hypervolume"], "low": low, "high": high, "reference": [corner[1], corner[0]]},
    }


def _dataset(session: Session, test_samples: Sequence[Sample]) -> dict:
    problem = session.problem
    frames = {"train": len(problem.train_samples), "valid": len(problem.valid_samples), "test": len(test_samples)}
    return {"path": str(session.dataset.path), "scene": session.dataset.scene.name, "frames": frames}


def _counts(run: RunFolder) -> dict[str, dict[str, int]]:
    retrainings = [record for records in run.retrainings().values() for record in records]
    return count_outcomes([*run.trials(), *retrainings])


def _seconds_before(session: Session, stage: str) -> float:
    names = list(session.study.stages)
    return sum(session.run.result(name)["seconds"] for name in names[: names.index(stage)])


def _of_earlier_stages(session: Session, stage: str) -> Mapping:
    """What the stages before this one have found, their own parts of the summary."""
    found: dict = {}
    names = list(session.study.stages)
    for name in names[: names.index(stage)]:
        result = session.run.result(name)
        found |= {key: value for key, value in result.items() if key not in ("kind", "seconds", "finalists", "spent")}
    return found
