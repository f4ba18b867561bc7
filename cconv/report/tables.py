"""A run folder as tidy tables. Reads our records only; neither Ray nor torch is imported."""

from collections.abc import Mapping

import pandas as pd

from cconv.study.records import RunFolder


def trials_table(run: RunFolder) -> pd.DataFrame:
    """One row a search trial: stage, outcome, updates, last validation error, seconds, parameters, hyperparameters."""
    rows = [
        {
            "trial": record.id,
            "stage": record.stage,
            "outcome": record.outcome,
            "updates": record.last["updates"] if record.last else 0,
            "valid_normalized_mse": record.last["valid_normalized_mse"] if record.last else float("nan"),
            "seconds": record.log[-1]["seconds"] if record.log else 0.0,
            "num_parameters": record.config["num_parameters"],
            **record.parameters,
        }
        for record in run.trials()
    ]
    return pd.DataFrame(rows)


def curves_table(run: RunFolder) -> pd.DataFrame:
    """One row an evaluation of a search trial or retraining: name, stage, seed, updates, errors."""
    rows = [
        {"name": record.id, "stage": record.stage, "seed": record.config["init_seed"], **entry}
        for record in run.trials()
        for entry in record.log
    ]
    rows += [
        {"name": finalist, "stage": record.stage, "seed": record.config["init_seed"], **entry}
        for finalist, records in run.retrainings().items()
        for record in records
        for entry in record.log
    ]
    return pd.DataFrame(rows)


def finalists_table(summary: Mapping) -> pd.DataFrame:
    """One row a finalist: test errors with interval, cost, parameters; most accurate first."""
    rows = []
    for entry in summary["finalists"]:
        low, high = entry["test"]["ci95"]
        rows.append(
            {
                "model": entry["id"],
                "normalized_mse": entry["test"]["normalized_mse"],
                "ci95_low": low,
                "ci95_high": high,
                "relative_rmse": entry["test"]["relative_rmse"],
                "per_frame_normalized_mse": entry["test"]["per_frame_normalized_mse"],
                "ms_per_frame": entry["cost"]["ms_per_frame"],
                "ms_low": entry["cost"]["ms_low"],
                "ms_high": entry["cost"]["ms_high"],
                "us_per_particle": entry["cost"]["us_per_particle"],
                "peak_mb": entry["cost"]["peak_mb"],
                "flops_per_particle": entry["cost"]["flops_per_particle"],
                "num_parameters": entry["num_parameters"],
                "train_seconds": entry["train_seconds"],
                **entry["config"]["parameters"],
            }
        )
    return pd.DataFrame(rows).sort_values("normalized_mse", ignore_index=True)
