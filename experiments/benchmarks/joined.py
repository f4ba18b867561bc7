"""Time of training steps and validations with several windows in one graph, beside one window after another.

    python experiments/benchmarks/joined.py --data FOLDER [FOLDER ...] [--out FOLDER] [--windows 4] [--rounds 9]

The network is that of `experiments/rollout_taylor_green.toml`, its weights drawn at random, which does not change
times. A training step draws a batch (with noise, so that nothing is cached), and takes losses and derivatives; a
validation rolls all windows out for a few frames; a frame is the first of a rollout. Both ways take turns, so that
other processes disturb them alike; ratios are of CPU time, medians with quartiles; wall times mean something on an idle
machine only. Folders are in the LagrangeBench layout; those of periodic flows without walls, e.g. `cconv data generate
taylor_green_2d --size small --out FOLDER`. Writes `joined.json`.
"""

import argparse
import json
import os
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
import torch

from cconv.batching import groups_of
from cconv.data.dataset import open_dataset
from cconv.data.window import Windows
from cconv.evaluation.rollout_errors import rollouts_of
from cconv.models.model import Model, build_model
from cconv.rollout.rollout import rollout
from cconv.study.studies import load_study
from cconv.tasks import task_named
from cconv.tasks.samples import WindowSamples
from cconv.tasks.task import as_step
from cconv.training.augmentation import RandomWalkNoise
from cconv.training.examples import AugmentedExamples
from cconv.training.loop import losses_of
from cconv.training.losses import LOSSES
from cconv.training.unroll import Pushforward

STUDY = Path(__file__).parents[1] / "rollout_taylor_green.toml"
FEATURES = ("one", "density", "accelerations", "velocity")  # those that a periodic flow has
FRAMES = 3  # of each rollout: a network without training soon clumps the particles
WAYS = ("joined", "one by one")


def problem_of(folder: Path, windows: int) -> tuple[WindowSamples, Model]:
    """So many windows of the training split, evenly spread, and a fresh model."""
    study, dataset = load_study(STUDY, []), open_dataset(folder)
    task = as_step(task_named("acceleration", study.task.kernel))
    trajectories = list(dataset.trajectories("train"))
    every = Windows(trajectories, task.history, FRAMES)
    samples = WindowSamples(every[:: max(1, len(every) // windows)][:windows], dataset.scene, task)
    generator = torch.Generator().manual_seed(0)
    return samples, build_model(study.configuration.network, task, FEATURES, dataset.scene, list(samples), generator)


def training_step(samples: WindowSamples, model: Model) -> None:
    """Losses and derivatives of a batch of all windows."""
    model.zero_grad()
    examples = AugmentedExamples(samples, RandomWalkNoise(0.003), Pushforward(0, 0), seed=0)
    for sample in examples.draw(range(len(samples)), 1, model):
        losses = losses_of(model, sample, lambda each: model.geometry(each.inputs), LOSSES["balanced_mse"], 1)
        torch.stack(losses).sum().backward()


def validation(samples: WindowSamples, model: Model) -> None:
    """Rollouts from all windows."""
    rollouts_of(model, samples)


def frame(samples: WindowSamples, model: Model) -> None:
    """A frame of a rollout from each window."""
    with torch.no_grad():
        for sample in samples:
            next(rollout(model, sample.window, sample.scene))


def compared(work: Callable[[WindowSamples, Model], None], samples: WindowSamples, model: Model, rounds: int) -> dict:
    """CPU time and wall time of both ways, ms, and the ratio of CPU times; the first round is a warm-up."""
    times: dict[str, list[float]] = {way: [] for way in WAYS}
    walls: dict[str, list[float]] = {f"{way}, wall": [] for way in WAYS}
    for turn in range(rounds + 1):
        for way in WAYS if turn % 2 else WAYS[::-1]:
            # Groups of at most no particles are single windows, those of at most all particles hold every window.
            most = 10**9 if way == "joined" else 0
            with patch("cconv.data.window.groups_of", lambda counts, kinds, most=most: groups_of(counts, kinds, most)):
                before, clock = time.process_time(), time.perf_counter()
                work(samples, model)
                spent, passed = 1e3 * (time.process_time() - before), 1e3 * (time.perf_counter() - clock)
            if turn:
                times[way].append(spent)
                walls[f"{way}, wall"].append(passed)
    ratios = np.array(times["one by one"]) / np.array(times["joined"])
    rows: dict[str, Any] = {way: quartiles(found) for way, found in (times | walls).items()}
    return rows | {"one by one / joined": quartiles(ratios)}


def quartiles(values: Sequence[float] | np.ndarray) -> dict[str, float]:
    low, median, high = np.percentile(values, [25, 50, 75]).tolist()
    return {"median": median, "low": low, "high": high}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, nargs="+", required=True, help="folders of data sets")
    parser.add_argument("--out", type=Path, default=Path("runs/benchmarks/joined"), help="folder to write")
    parser.add_argument("--windows", type=int, default=4, help="windows of a batch, and of a validation")
    parser.add_argument("--rounds", type=int, default=9, help="timed turns")
    parser.add_argument("--threads", type=int, default=1, help="threads of torch and of compiled loops")
    parser.add_argument("--smoke", action="store_true", help="two turns, to see that the script runs")
    arguments = parser.parse_args()
    torch.set_num_threads(arguments.threads)
    results: dict[str, Any] = {
        "machine": f"{os.cpu_count()} cores, torch {torch.__version__}",
        "load": os.getloadavg()[0],
        "threads": arguments.threads,
        "windows": arguments.windows,
        "data": [],
    }
    for folder in arguments.data:
        samples, model = problem_of(folder, arguments.windows)
        row: dict[str, Any] = {"data": folder.name, "particles": len(samples.window(0).masses)}
        for work in (training_step, validation, frame):
            row[work.__name__] = compared(work, samples, model, 2 if arguments.smoke else arguments.rounds)
        results["data"].append(row)
        print(json.dumps(row))
    arguments.out.mkdir(parents=True, exist_ok=True)
    (arguments.out / "joined.json").write_text(json.dumps(results, indent=1) + "\n")


if __name__ == "__main__":
    main()
