"""Times and memory on whatever devices this machine has, against N and beside the targets; up to a million particles.

    python experiments/benchmarks/devices.py [--out FOLDER] [--threads 2] [--largest 1000000] [--dims 2 3]

On the CPU it takes everything that a user does with particles at growing sizes, each in a process of its own, whose
largest memory counts whole: inspect a data set, fit a closed form, evaluate it, predict a density rate by it and by
analytic SPH in turns, one frame of a rollout (the network of experiments/rollout_taylor_green.toml, weights at random)
and one step of the solver. CPU time is that of all threads together, which other processes disturb less. On an NVIDIA
GPU it takes the convolution, the search for neighbours, a training step and a frame of a rollout. What this machine
cannot measure is named so in the table. Writes devices.json, devices.md and devices.png.
"""

import argparse
import json
import math
import os
import platform
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
import torch

import cconv
from cconv.data.inspect import inspect_dataset
from cconv.data.trajectory import Frame, ParticleType, Scene
from cconv.data.window import Window
from cconv.devices import find_device, name_of, wait_for
from cconv.domain import Box
from cconv.evaluation.memory import peak_resident_megabytes
from cconv.models.closed_form import fit_closed_form, solve_closed_form
from cconv.models.errors import frame_errors, normalized_mse
from cconv.models.model import Model, build_model
from cconv.neighbors import radius_graph
from cconv.networks import ConvNetSettings, RadialNetSettings
from cconv.nn import ConvGeometry, continuous_conv
from cconv.rollout.rollout import rollout
from cconv.sph.compiled import compiled_sums
from cconv.sph.kernels import CubicSpline, QuinticSpline
from cconv.sph.solver import EquationOfState, Scheme, WeaklyCompressibleSPH
from cconv.study.studies import load_study
from cconv.tasks import task_named
from cconv.tasks.samples import iterate_samples, make_sample, make_step_sample

STUDY = Path(__file__).parents[1] / "rollout_taylor_green.toml"
SIZES = (1000, 10_000, 100_000, 1_000_000)
STEP_FEATURES = ("one", "density", "accelerations", "velocity")
FIELD_FEATURES = (
    "one",
    "velocity",
)  # with nine radial terms 18 coefficients, as the model recommended for the dam break
CLOCKS = ("seconds", "cpu_seconds")
HISTORY = 6
FASTEST = 0.1  # particle spacings in a frame
TARGETS = (  # what, device, limit, unit, key of the measurement
    ("96 → 64 channels, N = 4,000, forward + backward ÷ bare products", "cuda", 2.0, "", "conv_ratio"),
    ("the same layer, largest memory at N = 128,000", "cuda", 1.5, "GB", "conv_gb"),
    ("neighbour search at N = 128,000", "cuda", 3.0, "ms", "search_ms"),
    ("training step of the published ConvNet on a frame of 3,456 particles", "cuda", 4.0, "ms", "training_ms"),
    ("frame of the Taylor–Green model's rollout, 2,500 particles", "cuda", 2.0, "ms", "rollout_ms"),
    ("density rate by a closed form ÷ by analytic SPH, 10⁶ particles in 3D", "cpu", 1.5, "", "density_rate_ratio"),
    ("its largest memory, the whole process", "cpu", 6.0, "GB", "density_rate_gb"),
    ("largest exponent of CPU time against N, 10³ to 10⁶", "cpu", 1.05, "", "exponent"),
)


# Particles: a jittered lattice in a periodic box of unit length, in a smooth flow.


def side_of(particles: int, dim: int) -> int:
    return round(particles ** (1 / dim))


def particles_in_box(side: int, dim: int) -> tuple[torch.Tensor, torch.Tensor]:
    """Positions and velocities (side^D, D), float64; velocities are lengths in a frame."""
    generator = torch.Generator().manual_seed(0)
    ticks = (torch.arange(side, dtype=torch.float64) + 0.5) / side
    lattice = torch.cartesian_prod(*[ticks] * dim).reshape(-1, dim)
    positions = lattice + 0.3 / side * (torch.rand(lattice.shape, generator=generator, dtype=torch.float64) - 0.5)
    velocities = FASTEST / side * torch.sin(2 * math.pi * positions.roll(1, dims=1) + torch.arange(dim))
    return positions, velocities


def scene_of(side: int, dim: int) -> Scene:
    return Scene(
        name="box",
        dim=dim,
        particle_spacing=1 / side,
        frame_dt=1.0,
        box=Box([0] * dim, [1] * dim, True),
        force=None,
        has_boundary=False,
        velocity_source="stored",
        mass_source="stored",
        missing=(),
    )


def frame_of(side: int, dim: int) -> Frame:
    positions, velocities = particles_in_box(side, dim)
    return Frame(
        positions=positions.float(),
        velocities=velocities.float(),
        masses=torch.full((side**dim,), side ** -float(dim)),
        particle_types=torch.full((side**dim,), int(ParticleType.FLUID)),
        boundary=None,
    )


def window_of(side: int, dim: int, history: int = HISTORY) -> Window:
    positions, velocities = particles_in_box(side, dim)
    scene, times = scene_of(side, dim), range(1 - history, 2)
    path = torch.stack([scene.box.wrap(positions + time * velocities).float() for time in times])
    return Window(
        positions=path[:history],
        future=path[history:],
        masses=torch.full((side**dim,), side ** -float(dim)),
        particle_types=torch.full((side**dim,), int(ParticleType.FLUID)),
        boundary=None,
        trajectory="box",
        frame=history - 1,
    )


def write_box(folder: Path, side: int, dim: int, frames: int = 2) -> None:
    """A data set of three trajectories, one a split."""
    positions, velocities = (each.float().numpy() for each in particles_in_box(side, dim))
    runs = [
        cconv.ParticleArrays(
            positions=np.stack([(positions + (frames * run + frame) * velocities) % 1.0 for frame in range(frames)]),
            velocities=np.stack([velocities * (1 + 0.1 * (frames * run + frame)) for frame in range(frames)]),
        )
        for run in range(3)
    ]
    facts = cconv.SceneFacts(particle_spacing=1 / side, frame_dt=1.0, box=Box([0] * dim, [1] * dim, True))
    cconv.write_dataset(folder, runs, facts)


def field_model(dim: int) -> Model:
    """The closed form of the density rate, fitted to a small box."""
    task = task_named("density_rate")
    sample = make_sample(frame_of(12, dim), scene_of(12, dim), task)
    layer = RadialNetSettings(layers=1, message="difference", relative_cutoff=2.0, radial_terms=9)
    model = build_model(layer, task, FIELD_FEATURES, scene_of(12, dim), [sample])
    solve_closed_form(model, [sample])
    return model.eval()


def step_model(dim: int) -> Model:
    """The network of the study file with random weights."""
    study = load_study(STUDY, [])
    task = task_named("acceleration", study.task.kernel)
    sample = make_step_sample(window_of(12, dim, task.history), scene_of(12, dim), task)
    generator = torch.Generator().manual_seed(0)
    network = study.configuration.network
    return build_model(network, task, STEP_FEATURES, scene_of(12, dim), [sample], generator).eval()


# Stages on the CPU: each makes what it needs, and returns calls that are timed in turns.

Calls = dict[str, Callable[[], Any]]


def inspect(side: int, dim: int, data: Path) -> Calls:
    return {"inspect": lambda: inspect_dataset(cconv.open_dataset(data))}


def fit(side: int, dim: int, data: Path) -> Calls:
    layer = RadialNetSettings(layers=1, message="difference", relative_cutoff=2.0, radial_terms=9)
    return {"fit": lambda: fit_closed_form(cconv.open_dataset(data), network=layer, features=FIELD_FEATURES)}


def evaluate(side: int, dim: int, data: Path) -> Calls:
    model = field_model(dim)

    def call() -> float:
        samples = iterate_samples(cconv.open_dataset(data), "test", model.task)
        return normalized_mse(frame_errors(model, samples))

    return {"evaluate": call}


def density_rate(side: int, dim: int, data: Path) -> Calls:
    """A closed form and analytic SPH from the same stored frame, each with its own search for neighbours."""
    model, frame, scene = field_model(dim), frame_of(side, dim), scene_of(side, dim)
    sums = compiled_sums(CubicSpline(1 / side, dim))

    def analytic() -> torch.Tensor:
        edges = radius_graph(frame.positions, sums.kernel.support_radius, scene.box)
        return sums.density_rate(frame.masses, frame.velocities, edges)

    return {"density rate, closed form": lambda: model.predict_frame(frame, scene), "density rate, analytic": analytic}


def rollout_frame(side: int, dim: int, data: Path) -> Calls:
    model, window, scene = step_model(dim), window_of(side, dim), scene_of(side, dim)
    return {"rollout frame": lambda: next(rollout(model, window, scene))}


def solver_step(side: int, dim: int, data: Path) -> Calls:
    positions, velocities = particles_in_box(side, dim)
    solver = WeaklyCompressibleSPH(
        kernel=QuinticSpline(1 / side, dim),
        box=Box([0] * dim, [1] * dim, True),
        particle_spacing=1 / side,
        equation_of_state=EquationOfState(rest_density=1.0, sound_speed=10.0),
        scheme=Scheme(),
    )
    count = len(positions)
    masses, viscosities = torch.full((count,), 1 / count), torch.full((count,), 0.01)
    state = solver.initial_state(positions, velocities, masses, viscosities, torch.zeros(count, dtype=torch.bool), True)
    step = 0.05 / side / 10
    solver.step(state, step)  # finds the neighbours, which hold for many steps
    return {"solver step": lambda: solver.step(state, step)}


STAGES = {each.__name__: each for each in (inspect, fit, evaluate, density_rate, rollout_frame, solver_step)}


def run_stage(stage: str, particles: int, dim: int, threads: int, repeats: int, data: Path) -> dict:
    """Time the calls of a stage in this process, after a warm-up on a small box that loads compiled loops."""
    torch.set_num_threads(threads)
    with tempfile.TemporaryDirectory() as folder:
        write_box(Path(folder) / "small", 12, dim)
        for call in STAGES[stage](12, dim, Path(folder) / "small").values():
            call()
    calls = STAGES[stage](side_of(particles, dim), dim, data)
    times: dict[str, list[tuple[float, float]]] = {name: [] for name in calls}
    for _ in range(repeats):
        for name, call in calls.items():
            used, clock = time.process_time(), time.perf_counter()
            call()
            times[name].append((time.perf_counter() - clock, time.process_time() - used))
    return {
        "peak_gb": peak_resident_megabytes() / 1024,
        "times": {
            name: {
                "seconds": statistics.median(t[0] for t in each),
                "cpu_seconds": statistics.median(t[1] for t in each),
            }
            for name, each in times.items()
        },
    }


def measured_on_cpu(sizes: Sequence[int], dims: Sequence[int], threads: int) -> list[dict]:
    """All stages at all sizes, one process after another."""
    rows = []
    for dim in dims:
        for size in sizes:
            with tempfile.TemporaryDirectory() as folder:
                data = Path(folder) / "data"
                write_box(data, side_of(size, dim), dim)
                for stage in STAGES:
                    found = in_own_process(stage, size, dim, threads, data)
                    for name, times in found["times"].items():
                        rows.append({"dim": dim, "particles": side_of(size, dim) ** dim, "what": name})
                        rows[-1] |= times | {"peak_gb": found["peak_gb"]}
                        print(json.dumps(rows[-1]), flush=True)
    return rows


def in_own_process(stage: str, size: int, dim: int, threads: int, data: Path) -> dict:
    repeats = 7 if size <= 10_000 else 3
    options = {"stage": stage, "particles": size, "dim": dim, "threads": threads, "repeats": repeats, "data": data}
    command = [sys.executable, __file__, *(f"--{name}={value}" for name, value in options.items())]
    finished = subprocess.run(command, capture_output=True, text=True, check=False)
    if finished.returncode:
        raise SystemExit(f"{stage} at {size} particles in {dim}D failed:\n{finished.stderr}")
    return json.loads(finished.stdout.splitlines()[-1])


def exponents(rows: Sequence[dict]) -> dict[str, float]:
    """Slope of log CPU time against log N of each stage, by least squares."""
    found = {}
    for what, dim in sorted({(row["what"], row["dim"]) for row in rows}):
        own = [row for row in rows if (row["what"], row["dim"]) == (what, dim)]
        if len(own) > 1:
            logs = np.log([[row["particles"], row["cpu_seconds"]] for row in own])
            found[f"{what}, {dim}D"] = float(np.polyfit(*logs.T, 1)[0])
    return found


def of_cpu(rows: Sequence[dict], largest: int) -> dict[str, float]:
    """The measurements that targets are about."""
    own = {row["what"]: row for row in rows if row["dim"] == 3 and row["particles"] == largest}
    found: dict[str, float] = {}
    if "density rate, analytic" in own and largest >= SIZES[-1]:
        network, analytic = own["density rate, closed form"], own["density rate, analytic"]
        found["density_rate_ratio"] = network["seconds"] / analytic["seconds"]
        found["density_rate_gb"] = network["peak_gb"]
    if largest >= SIZES[-1] and (slopes := exponents(rows)):
        found["exponent"] = max(slopes.values())
    return found


# On an NVIDIA GPU.


def timed(call: Callable[[], Any], device: torch.device, repeats: int = 20) -> float:
    """Median time of a call after three that warm up, ms."""
    times = []
    for turn in range(repeats + 3):
        wait_for(device)
        clock = time.perf_counter()
        call()
        wait_for(device)
        times.append(1e3 * (time.perf_counter() - clock))
        del turn
    return statistics.median(times[3:])


@contextmanager
def peak_of(device: torch.device) -> Iterator[dict]:
    found: dict = {}
    torch.cuda.reset_peak_memory_stats(device)
    yield found
    wait_for(device)
    found["gb"] = torch.cuda.max_memory_allocated(device) / 2**30


def layer_on(device: torch.device, count: int) -> tuple[Callable[[], Any], Callable[[], Any]]:
    """Forward and backward pass of a layer of 96 to 64 channels in 3D, K = 4, and of its products alone."""
    side = side_of(count, 3)
    positions = particles_in_box(side, 3)[0].float().to(device)
    geometry = ConvGeometry(radius_graph(positions, 1.88 / side, Box([0] * 3, [1] * 3, True)), 4)  # 26 neighbours
    features = torch.randn(side**3, 96, device=device, requires_grad=True)
    filters = torch.randn(4, 4, 4, 96, 64, device=device, requires_grad=True)
    columns = torch.randn(side**3, 64 * 96, device=device) if side**3 <= 10_000 else None

    def layer() -> None:
        continuous_conv(features, filters, geometry).sum().backward()

    def products() -> None:
        assert columns is not None
        output = columns @ filters.detach().flatten(0, 3)
        gradient = torch.ones_like(output)
        columns.T @ gradient, gradient @ filters.detach().flatten(0, 3).T

    return layer, products


def measured_on_gpu(device: torch.device) -> dict[str, float]:
    layer, products = layer_on(device, 4000)
    found = {"conv_ratio": timed(layer, device) / timed(products, device)}
    layer, _ = layer_on(device, 128_000)
    with peak_of(device) as peak:
        layer()
    found["conv_gb"] = peak["gb"]
    found["conv_ms"] = timed(layer, device, 5)
    positions = particles_in_box(side_of(128_000, 3), 3)[0].float().to(device)
    found["search_ms"] = timed(lambda: radius_graph(positions, 1.88 / 50, Box([0] * 3, [1] * 3, True)), device)
    model, start = step_model(2).to(device), window_of(50, 2).to(device)
    found["rollout_ms"] = timed(lambda: next(rollout(model, start, scene_of(50, 2))), device)
    found["training_ms"] = timed(training_step(device), device)
    return found


def training_step(device: torch.device) -> Callable[[], None]:
    """A step of Adam of the published ConvNet on a frame of 3,375 particles in 3D without walls."""
    task = task_named("density_rate")
    sample = make_sample(frame_of(15, 3), scene_of(15, 3), task)
    model = build_model(ConvNetSettings(), task, ("one", "density", "velocity"), scene_of(15, 3), [sample]).to(device)
    placed, adam = sample.to(device), torch.optim.Adam(model.parameters())

    def step() -> None:
        adam.zero_grad()
        prediction = model(placed.inputs, model.geometry(placed.inputs))
        (prediction - model.standardize_target(placed.target)).square().mean().backward()
        adam.step()

    return step


# What is written.


def table(found: dict[str, float], gpu: str | None) -> str:
    lines = ["| what | device | target | measured here |", "|---|---|---|---|"]
    for what, device, limit, unit, key in TARGETS:
        value = f"{found[key]:.3g} {unit}".strip() if key in found else "unmeasured here"
        where = device if device == "cpu" or gpu is None else gpu
        lines.append(f"| {what} | {where} | ≤ {limit:g} {unit} | {value} |".replace("  ", " "))
    return "\n".join(lines) + "\n"


def draw(rows: Sequence[dict], path: Path) -> None:
    """CPU time and memory against the number of particles, in logarithmic scales."""
    dims = sorted({row["dim"] for row in rows})
    figure, axes = plt.subplots(2, len(dims), figsize=(5 * len(dims), 7.5), squeeze=False, layout="constrained")
    for column, dim in enumerate(dims):
        for what in dict.fromkeys(row["what"] for row in rows):
            own = [row for row in rows if (row["what"], row["dim"]) == (what, dim)]
            sizes = [row["particles"] for row in own]
            axes[0, column].loglog(sizes, [row["cpu_seconds"] for row in own], "o-", label=what)
            axes[1, column].loglog(sizes, [row["peak_gb"] for row in own], "o-", label=what)
        axes[0, column].set(title=f"{dim}D", ylabel="CPU time, s")
        axes[1, column].set(xlabel="particles", ylabel="largest memory of the process, GB")
    axes[0, 0].legend(fontsize=8)
    figure.savefig(path, dpi=110)
    plt.close(figure)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=Path("runs/benchmarks/devices"))
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--largest", type=int, default=SIZES[-1])
    parser.add_argument("--dims", type=int, nargs="+", default=[3, 2])
    parser.add_argument("--smoke", action="store_true", help="sizes too small for their figures to mean anything")
    parser.add_argument("--stage", choices=STAGES, help=argparse.SUPPRESS)
    for name in ("particles", "dim", "repeats"):
        parser.add_argument(f"--{name}", type=int, help=argparse.SUPPRESS)
    parser.add_argument("--data", type=Path, help=argparse.SUPPRESS)
    asked = parser.parse_args()
    if asked.stage:
        print(json.dumps(run_stage(asked.stage, asked.particles, asked.dim, asked.threads, asked.repeats, asked.data)))
        return
    sizes = (216, 1000) if asked.smoke else [size for size in SIZES if size <= asked.largest]
    rows = measured_on_cpu(sizes, asked.dims, asked.threads)
    found, gpu = of_cpu(rows, max(row["particles"] for row in rows if row["dim"] == max(asked.dims))), None
    if torch.cuda.is_available():
        device = find_device("auto")
        found, gpu = found | measured_on_gpu(device), name_of(device)
    asked.out.mkdir(parents=True, exist_ok=True)
    machine = {"processor": platform.processor(), "cores": os.cpu_count(), "threads": asked.threads, "gpu": gpu}
    machine |= {"load_average": os.getloadavg(), "torch": torch.__version__}
    written = {"machine": machine, "targets": found, "exponents": exponents(rows), "rows": rows}
    (asked.out / "devices.json").write_text(json.dumps(written, indent=1) + "\n")
    (asked.out / "devices.md").write_text(table(found, gpu))
    draw(rows, asked.out / "devices.png")
    print(table(found, gpu))


if __name__ == "__main__":
    main()
