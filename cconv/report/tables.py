"""A run folder as tidy tables. Reads our records only; neither Ray nor torch is imported."""

import math
from collections.abc import Sequence

import pandas as pd

from cconv.study.records.found import RungImportance
from cconv.study.records.run_folder import RunFolder
from cconv.study.records.summary import FinalistEntry, Summary

ANALYTIC = "analytic SPH"
SOLVER = "SPH solver"
MEAN_PREDICTOR = "predicting the mean"  # of the training split, always and everywhere
WIDEST = 1e3  # ratio of the ends of an interval of errors from which on its upper end tells nothing
AUDIT_MEASURES = {"spearman": "rank correlation", "recall": "recall of the best", "regret": "regret"}


def trials_table(run: RunFolder) -> pd.DataFrame:
    """One row a search trial: stage, outcome, updates, last validation error, seconds, parameters, hyperparameters."""
    rows = [
        {
            "trial": record.id,
            "stage": record.stage,
            "outcome": record.outcome,
            "updates": record.last["updates"] if record.last else 0,
            "valid_error": record.last["valid_error"] if record.last else float("nan"),
            "seconds": record.log[-1]["seconds"] if record.log else 0.0,
            "num_parameters": record.config["num_parameters"],
            **record.parameters,
        }
        for record in run.trials()
    ]
    return pd.DataFrame(rows)


def curves_table(run: RunFolder) -> pd.DataFrame:
    """One row an evaluation of a search trial or retraining: name, stage, retrained, seed, updates, seconds, errors.

    The column "retrained" tells the trainings of finalists and ablations from trials of a search.
    """
    records = [(record.id, False, record) for record in run.trials()]
    records += [(name, True, record) for name, trained in run.retrainings().items() for record in trained]
    rows = [
        {
            "name": name,
            "stage": record.stage,
            "retrained": retrained,
            "seed": record.config["init_seed"],
            **entry,
        }
        for name, retrained, record in records
        for entry in record.log
    ]
    return pd.DataFrame(rows)


def finalists_table(summary: Summary) -> pd.DataFrame:
    """One row a finalist: errors with the interval of the test error, cost, parameters; most accurate first.

    Two rows say what the errors and times mean: predicting the mean of the training split, and analytic SPH. Intervals
    are empty where there are too few seeds or units for one.
    """
    rows = _reference_rows(summary)
    for entry in summary.finalists:
        low, high = entry.test.ci95 or (math.nan, math.nan)
        rows.append(
            {
                "model": entry.id,
                "valid_error": entry.valid.error,
                "test_error": entry.test.error,
                "ci95_low": low,
                "ci95_high": high,
                **entry.test.measures,
                "ms_per_frame": entry.cost.ms_per_frame,
                "ms_low": entry.cost.ms_low,
                "ms_high": entry.cost.ms_high,
                "us_per_particle": entry.cost.us_per_particle,
                "peak_mb": entry.cost.peak_mb,
                "flops_per_particle": entry.cost.flops_per_particle,
                "num_parameters": entry.num_parameters,
                "stable": entry.stability.stable,
                "train_seconds": entry.train_seconds,
                **entry.config.parameters,
            }
        )
    return pd.DataFrame(rows).sort_values("test_error", ignore_index=True)


def finalists_rows(summary: Summary) -> list[dict]:
    """Rows of `finalists_table`, each with whether it is on the front, and with its finalist as "entry".

    The rows of the mean predictor and of analytic SPH have None there.
    """
    rows = finalists_table(summary).to_dict("records")
    return [
        row | {"on_front": row["model"] in summary.pareto_front, "entry": summary.finalist(row["model"])}
        for row in rows
    ]


def speed_accuracy_table(summary: Summary) -> pd.DataFrame:
    """One row a point of the speed-accuracy chart.

    Columns: name; kind ("finalist", "search", "solver" or "analytic"); group, the stage of a search point or what marks
    a finalist ("recommended", "baseline", "thesis's best", "finalist"); error, error_low, error_high (of the test split
    for finalists, of the validation split for search points, of some rollouts of the test split for solvers, 0 for
    analytic SPH; the interval is empty where there are too few seeds or units for one); ms, ms_low, ms_high per frame;
    measured, whether the time was measured or estimated; num_parameters; outcome; on_front, by validation errors;
    hyperparameters, a dict.
    """
    rows = [*_finalist_points(summary), *_search_points(summary), *_solver_points(summary)]
    analytic = summary.analytic
    if analytic:
        times = {"ms": analytic.ms_per_frame, "ms_low": analytic.ms_low, "ms_high": analytic.ms_high}
        rows.append({"name": ANALYTIC, "kind": "analytic", "group": ANALYTIC, "error": 0.0} | times)
    defaults = {"measured": True, "outcome": "completed", "on_front": False}
    return pd.DataFrame([defaults | row for row in rows])


def growth_table(summary: Summary) -> pd.DataFrame:
    """One row a model and number of particles: time per frame with quartiles, and its two parts, in ms."""
    models = summary.growth.models
    return pd.DataFrame([{"model": name, **dict(size)} for name, sizes in models.items() for size in sizes])


def strategies_table(summary: Summary) -> pd.DataFrame:
    """One row a point of the best-so-far curve of each search strategy: strategy, updates spent, error."""
    strategies = summary.references.strategies if summary.references else {}
    rows = [(name, *point) for name, strategy in strategies.items() for point in strategy.curve]
    return pd.DataFrame(rows, columns=["strategy", "updates", "error"])


def rung_audit_table(summary: Summary) -> pd.DataFrame:
    """One row a rung: updates, trials, the measures of the audit, the correlation's interval or why none, the verdict.

    Measures of a rung that too few trials reached are empty.
    """
    rows = []
    for rung in summary.rung_audit:
        low, high = rung.spearman_ci95 or (math.nan, math.nan)
        rows.append(
            {
                "updates": rung.updates,
                "trials": rung.trials,
                **{name: getattr(rung, name) for name in AUDIT_MEASURES},
                "spearman_low": low,
                "spearman_high": high,
                "why_no_interval": rung.why_no_interval,
                "verdict": rung.verdict,
            }
        )
    return pd.DataFrame(rows)


def importance_table(importance: Sequence[RungImportance]) -> pd.DataFrame:
    """One row a rung and hyperparameter, the largest share first; rungs without importances are left out.

    Columns: updates; hyperparameter; share of the variance with its 95 % interval from low to high; p_value, adjusted
    for the number of hyperparameters; decided; f_anova and ped_anova, which have no interval.
    """
    rows = [
        {"updates": entry.updates, "hyperparameter": name, **dict(each)}
        for entry in importance
        for name, each in sorted(entry.parameters.items(), key=lambda item: -(item[1].share or 0.0))
    ]
    return pd.DataFrame(rows)


def _reference_rows(summary: Summary) -> list[dict]:
    mean, analytic = summary.mean_predictor, summary.analytic
    rows: list[dict] = [{"model": MEAN_PREDICTOR, "valid_error": mean.valid, "test_error": mean.test}]
    if analytic:
        exact = dict.fromkeys(("valid_error", "test_error", *summary.task.measures), 0.0)
        times = {name: getattr(analytic, name) for name in ("ms_per_frame", "ms_low", "ms_high")}
        rows.append({"model": ANALYTIC} | exact | times)
    return rows


def _finalist_points(summary: Summary) -> list[dict]:
    marks = {"thesis_best": "thesis's best", summary.baseline: "baseline", summary.recommended.id: "recommended"}
    return [_finalist_point(entry, summary, marks.get(entry.id, "finalist")) for entry in summary.finalists]


def _finalist_point(entry: FinalistEntry, summary: Summary, group: str) -> dict:
    low, high = entry.test.ci95 or (math.nan, math.nan)
    return {
        "name": entry.id,
        "kind": "finalist",
        "group": group,
        "error": entry.test.error,
        "error_low": low,
        "error_high": high,
        "ms": entry.cost.ms_per_frame,
        "ms_low": entry.cost.ms_low,
        "ms_high": entry.cost.ms_high,
        "num_parameters": entry.num_parameters,
        "on_front": entry.id in summary.pareto_front,
        "hyperparameters": entry.config.parameters,
    }


def _search_points(summary: Summary) -> list[dict]:
    return [
        {
            "name": point.id,
            "kind": "search",
            "group": point.stage,
            "error": point.valid_error,
            "ms": point.ms_per_frame,
            "measured": point.measured,
            "num_parameters": point.num_parameters,
            "outcome": point.outcome,
            "hyperparameters": point.parameters,
        }
        for point in summary.search_points
    ]


def _solver_points(summary: Summary) -> list[dict]:
    points = summary.solver.points if summary.solver else ()
    return [
        {
            "name": f"{group}, {point.factor:.3g} times coarser" if point.factor != 1 else group,
            "kind": "solver",
            "group": group,
            "error": point.error,
            "ms": point.ms_per_frame,
            "ms_low": point.ms_low,
            "ms_high": point.ms_high,
        }
        for point in points
        for group in [SOLVER if point.sound_ratio == points[0].sound_ratio else f"{SOLVER}, slow sound"]
    ]


def has_upper_end(low: float, high: float) -> bool:
    """Tell whether the upper end of an interval of errors says anything.

    A few draws of very different errors, as of trainings some of which blow up, or of windows of a flow that comes to
    rest, leave errors possible that are larger by any number of decades.
    """
    return high <= WIDEST * low


def end_of_bar(error: float, low: float, high: float) -> float:
    """Where the bar of an interval ends in a chart: at its upper end, or at the error if that end says nothing."""
    return high if has_upper_end(low, high) else error


def error_interval(low: float, high: float, digits: int = 3) -> str:
    """Put an interval of errors into words, one without an upper end as "at least ..."."""
    return f"{low:.{digits}g} to {high:.{digits}g}" if has_upper_end(low, high) else f"at least {low:.{digits}g}"
