"""The initialisation stage: how much of the spread among configurations is the luck of initial weights (thesis, 4.1).

One configuration, the baseline, is trained with many seeds to the full budget. Its errors at each rung are set beside
those of the random search, whose trials share one seed and differ in configuration.
"""

import math
from collections.abc import Sequence

import numpy as np
import scipy.stats

from cconv.study.records import RunFolder, TrialRecord
from cconv.study.search import Job, Session, run_jobs

STAGE = "initialization"


def train_many_seeds(session: Session) -> None:
    """Train the baseline with as many seeds as the study asks for; none of them is used by another stage."""
    study, run = session.study, session.run
    first = study.seeds.init + 1 + study.finalists.seeds
    jobs = [
        Job(
            folder=run.trial(f"{STAGE}_{number:04d}").path,
            name=f"{STAGE}_{number:04d}",
            parameters=session.space.baseline,
            init_seed=first + number,
        )
        for number in range(study.initialization.seeds)
    ]
    run_jobs(session, jobs, STAGE, study.training)


def variance_decomposition(run: RunFolder) -> list[dict]:
    """One entry a rung of the random search, as they stand in summary.json; none without the stage.

    Returns:
        Entries of "updates"; "seeds" and "configurations", how many of each reached the rung; "seed_spread" and
        "configuration_spread", standard deviations of the decimal logarithm of the error; "seed_share", the
        variance over seeds by that over configurations (which holds both), and "seed_share_ci95", its interval by the
        F-distribution. From the second rung on the configurations are those that were not stopped.
    """
    records = run.trials()
    seeds = [record for record in records if record.stage == STAGE]
    rungs = run.read("rungs.json").get("random", []) if seeds else []
    entries = []
    for rung in rungs:
        over_seeds = _logarithms(_error_at(record, rung["updates"]) for record in seeds)
        over_configurations = _logarithms(rung["recorded"].values())
        if min(len(over_seeds), len(over_configurations)) > 1:
            entries.append({"updates": rung["updates"], **_compare(over_seeds, over_configurations)})
    return entries


def _compare(over_seeds: Sequence[float], over_configurations: Sequence[float]) -> dict:
    variances = [float(np.var(values, ddof=1)) for values in (over_seeds, over_configurations)]
    freedom = [len(values) - 1 for values in (over_seeds, over_configurations)]
    share = variances[0] / variances[1] if variances[1] > 0 else None
    interval = None
    if share is not None:
        low, high = (scipy.stats.f.ppf(level, *freedom) for level in (0.025, 0.975))
        interval = [float(share / high), float(share / low)]
    return {
        "seeds": len(over_seeds),
        "configurations": len(over_configurations),
        "seed_spread": math.sqrt(variances[0]),
        "configuration_spread": math.sqrt(variances[1]),
        "seed_share": share,
        "seed_share_ci95": interval,
    }


def _error_at(record: TrialRecord, updates: int) -> float | None:
    return next((entry["valid_normalized_mse"] for entry in record.log if entry["updates"] == updates), None)


def _logarithms(errors) -> list[float]:
    return [math.log10(error) for error in errors if error is not None and error > 0]
