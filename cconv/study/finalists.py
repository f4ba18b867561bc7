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
    crossed_interval,
    frame_errors,
    normalized_mse,
    per_frame_normalized_mse,
)
from cconv.study.records import RunFolder, TrialRecord
from cconv.study.search import Job
from cconv.training.checkpoint import load_model, read_card, save_model

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


@dataclass(frozen=True, kw_only=True)
class Retrained:
    """A finalist all of whose retrainings finished.

    Attributes:
        id: Its id.
        records: Its retrainings, one a seed.
        checkpoints: Checkpoint folder of each.
    """

    id: str
    records: list[TrialRecord]
    checkpoints: list[Path]

    @property
    def valid_errors(self) -> list[float]:
        """Validation error of each checkpoint: the best of its evaluations."""
        logs = [record.log for record in self.records]
        return [min(entry["valid_normalized_mse"] for entry in log) for log in logs]

    @property
    def best_checkpoint(self) -> Path:
        """Checkpoint of the smallest validation error."""
        return self.checkpoints[int(np.argmin(self.valid_errors))]


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


def retrained_finalists(run: RunFolder, num_seeds: int) -> tuple[list[Retrained], dict[str, str]]:
    """Finalists all of whose seeds finished, a closed form's single fit, and for each other one what became of it."""
    retrained, failed = [], {}
    for finalist, records in run.retrainings().items():
        lost = [record for record in records if record.outcome != "completed"]
        wanted = 1 if records[0].is_closed_form else num_seeds
        if lost or len(records) < wanted:
            ends = [f"{record.id} {record.outcome} {record.reason}".strip() for record in lost]
            failed[finalist] = "; ".join(ends) or f"only {len(records)} of {wanted} seeds were trained"
        else:
            folders = [run.finalist(finalist, record.config["init_seed"]).checkpoint for record in records]
            retrained.append(Retrained(id=finalist, records=records, checkpoints=folders))
    return retrained, failed


def evaluate_finalist(finalist: Retrained, samples: Sequence[Sample], frames_per_block: int) -> dict:
    """Test errors of a finalist over its seeds, as they stand in summary.json.

    Args:
        finalist: The finalist.
        samples: Frames of the test split.
        frames_per_block: Frames of a unit of the interval where there is a single test trajectory.
    """
    errors = [frame_errors(load_model(checkpoint), samples) for checkpoint in finalist.checkpoints]
    by_seed = [normalized_mse(seed) for seed in errors]
    per_frame = [per_frame_normalized_mse(seed) for seed in errors]
    units = np.stack([blocks_of_errors(seed, frames_per_block) for seed in errors])
    if units.size == 1:  # one fit, one short trajectory: its frames are all that can vary
        units = np.stack([blocks_of_errors(seed, 1) for seed in errors])
    mean = float(np.mean(by_seed))
    return {
        "normalized_mse": mean,
        "relative_rmse": math.sqrt(mean),
        "per_frame_normalized_mse": None if None in per_frame else float(np.mean(per_frame)),
        "ci95": list(crossed_interval(units, mean)),
        "by_seed": dict(zip([record.id for record in finalist.records], by_seed, strict=True)),
        "units": {"count": units.shape[1], "worst": float(units.mean(axis=0).max())},
    }


def finalist_entry(finalist: Retrained, test: Mapping, cost: Cost, stability: Mapping, run: RunFolder) -> dict:
    """A finalist's entry in summary.json."""
    config = finalist.records[0].config
    return {
        "id": finalist.id,
        "config": {"network": config["network"], "training": config["training"], "parameters": config["parameters"]},
        "num_parameters": config["num_parameters"],
        "valid": {"normalized_mse": float(np.mean(finalist.valid_errors))},
        "test": dict(test),
        "cost": asdict(cost),
        "stability": dict(stability),
        "checkpoint": str(finalist.best_checkpoint.relative_to(run.path)),
        "train_seconds": float(np.mean([record.log[-1]["seconds"] for record in finalist.records])),
    }


def complete_cards(finalist: Retrained, test: Mapping, environment: Mapping) -> None:
    """Add test errors and provenance to the card beside each of a finalist's models."""
    for record, folder in zip(finalist.records, finalist.checkpoints, strict=True):
        own = {"normalized_mse": test["by_seed"][record.id]}
        card = read_card(folder) | {
            "finalist": finalist.id,
            "test": own | {"mean_over_seeds": test["normalized_mse"], "ci95": test["ci95"]},
            "data_sha256": environment["data"]["sha256"],
            "git_commit": environment["git_commit"],
        }
        save_model(load_model(folder), folder, card)
