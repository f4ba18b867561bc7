"""Time and memory of a frame of a rollout, from a thousand to a hundred thousand particles.

    python experiments/benchmarks/rollout.py [--out FOLDER] [--threads 1] [--rounds 9]

The network is that of `experiments/rollout_taylor_green.toml`, its weights drawn at random, which change neither time
nor memory; the particles are a random lattice in 2D that moves as Taylor-Green vortices. A frame is everything between
two states of a rollout: features, SPH densities, neighbours, network, integrator, check of the state. Sizes take turns.
CPU time is that of all threads together, which other processes disturb less. Writes `rollout.json`.
"""

import argparse
import json
import math
import os
import statistics
import time
from collections.abc import Mapping, Sequence
from multiprocessing import get_context
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import torch

from cconv.data.trajectory import ParticleType, Scene
from cconv.data.window import Window
from cconv.domain import Box
from cconv.evaluation.memory import peak_resident_megabytes
from cconv.models.model import Model, build_model
from cconv.rollout.rollout import rollout
from cconv.scenes import scene_named
from cconv.study.studies import load_study
from cconv.tasks import task_named
from cconv.tasks.samples import make_step_sample

STUDY = Path(__file__).parents[1] / "rollout_taylor_green.toml"
FEATURES = ("one", "density", "accelerations", "velocity")  # those that the vortices have
SIZES = (1000, 3000, 10_000, 30_000, 100_000)
FASTEST = 0.3  # particle spacings in a frame


def vortices(num_particles: int, history: int) -> tuple[Window, Scene]:
    """A window of about so many particles, and its scene."""
    side = round(math.sqrt(num_particles))
    generator = torch.Generator().manual_seed(0)
    ticks = (torch.arange(side, dtype=torch.float64) + 0.5) / side
    lattice = torch.cartesian_prod(ticks, ticks)
    positions = lattice + 0.3 / side * (torch.rand(lattice.shape, generator=generator, dtype=torch.float64) - 0.5)
    velocities = FASTEST / side * scene_named("taylor_green_2d").velocity(positions, 0.0)
    box = Box([0, 0], [1, 1], True)
    times = torch.arange(1 - history, 2)[:, None, None]
    path = box.wrap(positions + times * velocities)
    window = Window(
        positions=path[:history],
        future=path[history:],
        masses=torch.full((side**2,), 1 / side**2),
        particle_types=torch.full((side**2,), int(ParticleType.FLUID)),
        boundary=None,
        trajectory="vortices",
        frame=history - 1,
    )
    scene = Scene(
        name="vortices",
        dim=2,
        particle_spacing=1 / side,
        frame_dt=1.0,
        box=box,
        force=None,
        has_boundary=False,
        velocity_source="stored",
        mass_source="stored",
        missing=(),
    )
    return window, scene


def fresh_model() -> Model:
    """The network of the study file with random weights."""
    study = load_study(STUDY, [])
    task = task_named("acceleration", study.task.kernel)
    window, scene = vortices(400, task.history)
    sample = make_step_sample(window, scene, task)
    generator = torch.Generator().manual_seed(0)
    return build_model(study.configuration.network, task, FEATURES, scene, [sample], generator).eval()


def measure_memory(model: Model, sizes: Sequence[int], threads: int) -> list[float]:
    """How much frames of each size add to the peak memory of a process of its own, MB; loops are compiled before."""
    next(rollout(model, *vortices(400, model.task.history)))
    context, found = get_context("fork"), []
    for size in sizes:
        receiver, sender = context.Pipe(duplex=False)
        child = context.Process(target=send_growth, args=(sender, model, size, threads))
        child.start()
        sender.close()
        found.append(receiver.recv())
        child.join()
    return found


def send_growth(sender: Connection, model: Model, size: int, threads: int) -> None:
    torch.set_num_threads(threads)
    start = vortices(size, model.task.history)
    before = peak_resident_megabytes()
    for _ in range(2):
        next(rollout(model, *start))
    sender.send(peak_resident_megabytes() - before)


def measure_times(model: Model, sizes: Sequence[int], rounds: int) -> list[list[tuple[float, float]]]:
    """CPU time and time of each frame, ms, of each size; the first round is a warm-up.

    Each frame begins with the same window, because a network without training soon clumps the particles.
    """
    starts = [vortices(size, model.task.history) for size in sizes]
    times: list[list[tuple[float, float]]] = [[] for _ in sizes]
    for turn in range(rounds + 1):
        for start, found in zip(starts, times, strict=True):
            used, clock = time.process_time(), time.perf_counter()
            next(rollout(model, *start))
            if turn > 0:
                found.append((1e3 * (time.process_time() - used), 1e3 * (time.perf_counter() - clock)))
    return times


def growth(particles: Sequence[int], rows: Sequence[Mapping[str, Any]]) -> dict[str, float]:
    """Exponents of the times, slopes of log time against log N; the memory's slope and intercept; by least squares."""
    logs = [math.log(count) for count in particles]
    found = {
        f"{clock} exponent": statistics.linear_regression(logs, [math.log(row[clock]["median"]) for row in rows]).slope
        for clock in ("cpu_ms", "ms")
    }
    memory = statistics.linear_regression(particles, [row["added_mb"] for row in rows])
    return found | {"kb per particle": 1e3 * memory.slope, "mb besides": memory.intercept}


def quartiles(values: Sequence[float]) -> dict[str, float]:
    low, median, high = statistics.quantiles(values, n=4, method="inclusive")
    return {"median": median, "low": low, "high": high}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("runs/benchmarks/rollout"), help="folder to write")
    parser.add_argument("--threads", type=int, default=1, help="threads of torch and of compiled loops")
    parser.add_argument("--rounds", type=int, default=9, help="timed frames of each size")
    parser.add_argument("--smoke", action="store_true", help="small sizes, to see that the script runs")
    arguments = parser.parse_args()
    sizes = (400, 900) if arguments.smoke else SIZES
    torch.set_num_threads(1)  # until processes have been forked
    model = fresh_model()
    memory = measure_memory(model, sizes, arguments.threads)
    torch.set_num_threads(arguments.threads)
    times = measure_times(model, sizes, 2 if arguments.smoke else arguments.rounds)
    particles = [len(vortices(size, model.task.history)[0].masses) for size in sizes]
    rows = [
        {
            "num_particles": count,
            "cpu_ms": quartiles([used for used, _ in found]),
            "ms": quartiles([passed for _, passed in found]),
            "added_mb": added,
        }
        for count, found, added in zip(particles, times, memory, strict=True)
    ]
    results = {
        "machine": f"{os.cpu_count()} cores, torch {torch.__version__}",
        "threads": arguments.threads,
        "frames": rows,
        "growth": growth(particles, rows),
    }
    arguments.out.mkdir(parents=True, exist_ok=True)
    (arguments.out / "rollout.json").write_text(json.dumps(results, indent=1) + "\n")
    for row in rows:
        print(json.dumps(row))
    print("growth", json.dumps(results["growth"]))


if __name__ == "__main__":
    main()
