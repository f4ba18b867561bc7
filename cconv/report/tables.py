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
                "stable": entry["stability"]["stable"] if entry["stability"] else None,
                "train_seconds": entry["train_seconds"],
                **entry["config"]["parameters"],
            }
        )
    return pd.DataFrame(rows).sort_values("normalized_mse", ignore_index=True)


def stability_rows(summary: Mapping) -> list[tuple[str, list[str]]]:
    """One row a check of stability, with a cell for each finalist; none for a run that measured no stability."""
    checks = [entry["stability"] for entry in summary["finalists"]]
    if not all(checks):
        return []
    first = checks[0]
    rows = [("passes every check", ["yes" if check["stable"] else "no" for check in checks])]
    for regime, values in first["regimes"].items():
        label = f"regime {regime.replace('_', ' ')} ({100 * values['share']:.0f} % of the particles)"
        rows.append((label, [f"{check['regimes'][regime]['normalized_mse']:.3g}" for check in checks]))
    for frame in first["stress"]:
        errors = [check["stress"][frame] for check in checks]
        label = f"frame {frame.replace('_', ' ')}"
        rows.append((label, ["–" if error is None else f"{error:.3g}" for error in errors]))
    rows.append(("float32 from float64", [f"{check['precision']:.2g}" for check in checks]))
    if first["density_rollout"]:
        rollouts = [check["density_rollout"] for check in checks]
        rows.append(("integrated density, deviation", [f"{rollout['largest']:.3g}" for rollout in rollouts]))
        outside = [rollout["first_frame_outside"] for rollout in rollouts]
        label = f"first frame outside, of {rollouts[0]['frames']}"
        rows.append((label, ["never" if frame is None else str(frame) for frame in outside]))
    return rows
