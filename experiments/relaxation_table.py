"""Whole rollouts of checkpoints, plain and relaxed, as a table in Markdown: the measures of Neural SPH's tables.

    python experiments/relaxation_table.py --data FOLDER --relax 0.02,0.3,3 NAME=CHECKPOINT [NAME=CHECKPOINT ...]

Rows are the checkpoints without and with the relaxation (`_p`). Numbers are means over the trajectories of the split,
with the 95 % interval of `cconv.evaluation.statistics.mean_interval`: over trajectories and seeds, or over the seeds on
a single trajectory. Checkpoints of one name are trainings of one model with several seeds. Sinkhorn divergence,
densities, energies and Chamfer distance are those of the last frame, energies and Dirichlet energies as a multiple of
the stored ones. Where a rollout diverges, only the number of these is told.
"""

import argparse
from collections import defaultdict
from pathlib import Path

import numpy as np
import torch

from cconv import load_model, open_dataset
from cconv.data.stored_frames import StoredFrames
from cconv.evaluation.recorded_rollout import RecordedRollout, asked_rollout, record_rollout
from cconv.evaluation.statistics import mean_interval
from cconv.models.model import Model
from cconv.rollout.correctors import SPHRelaxation
from cconv.tasks.task import as_step

SHORT = 20  # frames of the published short rollouts
COLUMNS = ("MSE20", "MSE", "Sinkhorn", "E_kin", "mean abs(ρ - 1)", "Dirichlet", "Chamfer")


def measures(found: RecordedRollout) -> list[float]:
    """Measures of a rollout in the order of `COLUMNS`."""
    metrics = found.metrics
    own, stored = metrics.rollout, metrics.reference
    return [
        float(metrics.mse[:SHORT].mean()),
        float(metrics.mse.mean()),
        float(metrics.sinkhorn[-1]),
        float(own.e_kin[-1] / stored.e_kin[-1]),
        float(own.rho_mae[-1]),
        float(own.dirichlet[-1] / stored.dirichlet[-1]),
        float(metrics.chamfer[-1]),
    ]


def in_words(values: np.ndarray) -> str:
    """Mean of a table (seeds, trajectories), with its interval; that of seeds alone where there is one trajectory."""
    if not values.size:
        return "–"
    interval = mean_interval(values if values.shape[1] > 1 else values.T)
    if interval is None:
        return f"{values.mean():.2g}"
    return f"{values.mean():.2g} ({max(0.0, interval[0]):.2g} to {interval[1]:.2g})"


def rolled(model: Model, stored: StoredFrames, scene, relaxation: SPHRelaxation | None, frames: int | None):
    """A rollout from the first frame of a trajectory on."""
    correctors = () if relaxation is None else (relaxation,)
    return record_rollout(
        model, asked_rollout(as_step(model.task), stored, scene, frames=frames, correctors=correctors)
    )


def main() -> None:
    """Roll out and print a row as soon as it is known."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("checkpoints", nargs="+", metavar="NAME=CHECKPOINT")
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--split", default="test")
    parser.add_argument("--trajectories", type=int, default=1)
    parser.add_argument("--frames", type=int, help="frames of each rollout; by default all that are stored")
    parser.add_argument("--relax", required=True, metavar="ALPHA,BETA,LOOPS")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    alpha, beta, loops = arguments.relax.split(",")
    variants = {"": None, "_p": SPHRelaxation(float(alpha), float(beta), int(loops))}
    dataset, models = open_dataset(arguments.data), defaultdict(list)
    for each in arguments.checkpoints:
        name, _, path = each.partition("=")
        models[name].append(load_model(path))
    print(f"| model | ms per frame | {' | '.join(COLUMNS)} | diverged |")
    print("|" + "---|" * (len(COLUMNS) + 3))
    for name, trainings in models.items():
        for suffix, relaxation in variants.items():
            found = [
                [
                    rolled(
                        model, StoredFrames(dataset, arguments.split, k), dataset.scene, relaxation, arguments.frames
                    )
                    for k in range(arguments.trajectories)
                ]
                for model in trainings
            ]
            diverged = [[each.ended is not None for each in row] for row in found]
            finished = not np.any(diverged)
            table = np.array([[measures(each) for each in row] for row in found]) if finished else np.empty((0, 0, 7))
            ms = np.median([np.median(each.milliseconds) for row in found for each in row])
            cells = [in_words(table[:, :, column]) for column in range(len(COLUMNS))]
            ended = f"{np.sum(diverged)} of {np.size(diverged)}"
            print(f"| {name}{suffix} | {ms:.0f} | {' | '.join(cells)} | {ended} |", flush=True)


if __name__ == "__main__":
    main()
