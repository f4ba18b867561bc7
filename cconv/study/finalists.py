"""Finalists: the best configurations and the baseline retrained with fresh seeds, tested and timed."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from cconv.data.targets import Sample
from cconv.evaluation.cost import Cost
from cconv.evaluation.metrics import (
    blocks_of_errors,
    bootstrap_interval,
    frame_errors,
    normalized_mse,
    per_frame_normalized_mse,
)
from cconv.study.records import RunFolder, TrialRecord
from cconv.study.search import Job
from cconv.training.checkpoint import load_model

BASELINE = "baseline"


@dataclass(frozen=True, kw_only=True)
class Finalist:
    """A configuration that is retrained.

    Attributes:
        id: "baseline" or the id of the trial that found it.
        parameters: Its hyperparameters.
    """

    id: str
    parameters: dict


def finalist_jobs(finalists: Sequence[Finalist], num_seeds: int, first_seed: int, run: RunFolder) -> list[Job]:
    """Trainings of every finalist with `num_seeds` initialisation seeds that the search did not use.

    They run in this order; the costliest finalist, usually the baseline, is best given first.
    """
    return [
        Job(
            folder=run.finalist(finalist.id, seed).path,
            name=f"{finalist.id}/seed_{seed}",
            parameters=finalist.parameters,
            init_seed=seed,
        )
        for finalist in finalists
        for seed in range(first_seed, first_seed + num_seeds)
    ]


def finished_retrainings(run: RunFolder) -> dict[str, list[TrialRecord]]:
    """Retrainings of each finalist; those of a finalist with a seed that did not finish are left out."""
    return {
        finalist: records
        for finalist, records in run.retrainings().items()
        if all(record.outcome == "completed" and record.last is not None for record in records)
    }


def best_valid_error(record: TrialRecord) -> float:
    """Validation error of the record's checkpoint: the best of its evaluations."""
    return min(e["valid_normalized_mse"] for e in record.log if e["valid_normalized_mse"] is not None)


def checkpoint_of(run: RunFolder, finalist: str, records: Sequence[TrialRecord]) -> Path:
    """Checkpoint of a finalist's best seed by validation error."""
    best = min(records, key=best_valid_error)
    return run.path / "finalists" / finalist / best.id / "checkpoint"


def evaluate_finalist(
    run: RunFolder, finalist: str, records: Sequence[TrialRecord], samples: Sequence[Sample], frames_per_block: int
) -> dict:
    """Test errors of a finalist over its seeds, as they stand in summary.json.

    Args:
        run: The study's run folder.
        finalist: Its id.
        records: Its retrainings.
        samples: Frames of the test split.
        frames_per_block: Frames of a unit of the interval where there is a single test trajectory.
    """
    models = [load_model(run.path / "finalists" / finalist / record.id / "checkpoint") for record in records]
    errors = [frame_errors(model, samples) for model in models]
    by_seed = [normalized_mse(seed) for seed in errors]
    units = np.stack([blocks_of_errors(seed, frames_per_block) for seed in errors])
    mean = float(np.mean(by_seed))
    return {
        "normalized_mse": mean,
        "relative_rmse": math.sqrt(mean),
        "per_frame_normalized_mse": float(np.mean([per_frame_normalized_mse(seed) for seed in errors])),
        "ci95": list(bootstrap_interval(units)),
        "by_seed": dict(zip([record.id for record in records], by_seed, strict=True)),
        "units": {"count": units.shape[1], "worst": float(units.mean(axis=0).max())},
    }


def finalist_entry(
    finalist: str, records: Sequence[TrialRecord], test: Mapping, cost: Cost, checkpoint: Path, run: RunFolder
) -> dict:
    """A finalist's entry in summary.json."""
    config = records[0].config
    return {
        "id": finalist,
        "config": {"network": config["network"], "training": config["training"], "parameters": config["parameters"]},
        "num_parameters": config["num_parameters"],
        "valid": {"normalized_mse": float(np.mean([best_valid_error(record) for record in records]))},
        "test": dict(test),
        "cost": asdict(cost),
        "stability": None,
        "checkpoint": str(checkpoint.relative_to(run.path)),
        "train_seconds": float(np.mean([record.log[-1]["seconds"] for record in records])),
    }
