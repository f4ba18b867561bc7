"""Networks of steps side by side, scene by scene: what each reaches, and what it costs to run and to train."""

import math
from collections.abc import Sequence
from pathlib import PurePath
from statistics import fmean

import numpy as np
import pandas as pd

from cconv.evaluation.statistics import interval_beside
from cconv.report.compared_runs import ComparedRun
from cconv.report.published import published_results
from cconv.report.tables import MEAN_PREDICTOR, SOLVER
from cconv.study.records.rollouts import FinalistRollouts
from cconv.study.records.summary import Errors, FinalistEntry

COLUMNS = (
    "data", "study", "source", "network", "model", "parameters", "ms", "threads", "mse5", "horizon", "error",
    "ci95_low", "ci95_high", "seeds", "to_best", "frames", "mse", "ended", "sinkhorn", "e_kin", "updates",
    "cpu_minutes", "hours", "stable",
)  # fmt: skip
OURS = "measured"


def scores_table(runs: Sequence[ComparedRun]) -> pd.DataFrame:
    """One row a finalist of each study of steps, most accurate first; then the solver, and what others report.

    Columns: data, the folder's name; study; source, `OURS` or where a published row comes from; network in words and
    model, its id; parameters; ms per frame on so many threads of a CPU, of published rows a forward pass on an A6000;
    mse5; horizon, the frames behind error; ci95_low and ci95_high, the 95 % interval of error over trainings, all
    tested by the same rollouts; seeds, its trainings; to_best, error ÷ smallest of the study. Over whole test
    trajectories: frames, mse, ended, the earliest frame at which one of the rollouts ended early, sinkhorn, e_kin, the
    mean squared error of the kinetic energy. What a training took, mean: updates, cpu_minutes of its updates, hours
    with evaluations. stable. What is not known is NaN.
    """
    rows = [row for run in runs if run.summary.task.horizon is not None for row in _of_study(run)]
    return pd.DataFrame(rows, columns=list(COLUMNS))


def matrix(scores: pd.DataFrame) -> pd.DataFrame:
    """The errors of each network (rows) in each scene (columns), of networks that are in more than one of them.

    Args:
        scores: A table of `scores_table`.
    """
    same = scores.assign(network=scores["network"].where(scores["source"] == OURS, scores["network"] + ", published"))
    known = same[same["error"].notna()]
    wide = known.pivot_table(index="network", columns="data", values="error", aggfunc="min", sort=False)
    return wide[wide.notna().sum(axis=1) > 1].reset_index().rename_axis(columns=None)


def _of_study(run: ComparedRun) -> list[dict]:
    """All rows of a study."""
    summary = run.summary
    where = {"data": PurePath(summary.dataset.path).name, "study": run.label}
    own = {"source": OURS, "horizon": summary.task.horizon}
    smallest = min(entry.test.error for entry in summary.finalists)
    rows = [
        where | own | _of_finalist(entry, smallest) | _whole(run.rollouts.get(entry.id))
        for entry in sorted(summary.finalists, key=lambda entry: entry.test.error)
    ]
    if summary.solver is not None and summary.solver.points:
        exact = summary.solver.points[0]
        rows.append(where | own | {"network": SOLVER, "ms": exact.ms_per_frame, "error": exact.error})
    rows.append(where | own | {"network": MEAN_PREDICTOR, "error": summary.mean_predictor.test})
    return rows + [
        where | _published(each, summary.task.horizon) for each in published_results(summary).to_dict("records")
    ]


def _of_finalist(entry: FinalistEntry, smallest: float) -> dict:
    """Errors of the rollouts of a finalist, its cost, and what its training took."""
    low, high = _interval_over_trainings(entry.test)
    cpu = entry.train_cpu_seconds
    return {
        "network": entry.in_words or entry.id,
        "model": entry.id,
        "parameters": entry.num_parameters,
        "ms": entry.cost.ms_per_frame,
        "threads": entry.cost.threads,
        "mse5": entry.test.measures.get("MSE5"),
        "error": entry.test.error,
        "ci95_low": low,
        "ci95_high": high,
        "seeds": len(entry.test.by_seed),
        "to_best": entry.test.error / smallest if smallest else math.nan,
        "updates": entry.updates,
        "cpu_minutes": math.nan if cpu is None else cpu / 60,
        "hours": entry.train_seconds / 3600,
        "stable": entry.stability.stable,
    }


def _interval_over_trainings(test: Errors) -> tuple[float, float]:
    """The interval of the mean error over other trainings; NaN for too few, or a closed form."""
    trainings = np.array([list(test.by_seed.values())])  # they are the units here
    return interval_beside(test.error, trainings) or (math.nan, math.nan)


def _whole(rollouts: FinalistRollouts | None) -> dict:
    """Means over whole rollouts of all trainings; the errors only if all reached the last stored frame."""
    if rollouts is None or not rollouts.rolled:
        return {} if rollouts is None else {"ended": 1}
    rolled = rollouts.rolled
    early = [len(each.mse) for each in rolled if each.ended] + [1] * bool(rollouts.lost)
    known = {"frames": max(each.stored for each in rolled), "ended": min(early) if early else math.nan}
    if early:
        return known
    sinkhorn = [value for each in rolled for value in each.sinkhorn]
    return known | {
        "mse": fmean(fmean(each.mse) for each in rolled),
        "sinkhorn": fmean(sinkhorn) if sinkhorn else math.nan,
        "e_kin": fmean(each.e_kin_error for each in rolled),
    }


def _published(row: dict, horizon: int | None) -> dict:
    """A published row, whose error is that of rollouts as long as the study's, if it is known."""
    known = {name: row[name] for name in ("network", "source", "parameters", "ms", "mse5", "frames", "mse", "sinkhorn")}
    return known | {"horizon": horizon, "error": row["mse20"] if horizon == 20 else math.nan, "e_kin": row["e_kin"]}
