"""What a model costs: measured alone, with a fixed number of threads, always next to a reference in the same run."""

import itertools
import math
import resource
import statistics
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, replace
from multiprocessing import get_context
from pathlib import Path

import torch

from cconv.data.features import FluidState, Inputs
from cconv.data.targets import VECTOR_TASKS
from cconv.domain import Box
from cconv.evaluation.cost_model import Surroundings, estimate
from cconv.neighbors import radius_graph
from cconv.training.field_model import FieldConfig, FieldModel


@dataclass(frozen=True, kw_only=True)
class Cost:
    """Cost of predicting one frame, neighbour search included.

    The density among the input features is taken as given: a solver has it, and all models share it.

    Attributes:
        ms_per_frame: Median time of a frame, ms.
        ms_low: Lower quartile.
        ms_high: Upper quartile.
        geometry_ms: Median time of neighbour search and geometry.
        network_ms: Median time of the network alone.
        us_per_particle: Median time over the number of fluid particles, µs.
        peak_mb: Memory that predictions add to a fresh process at most, MB.
        flops_per_particle: Multiplications and additions of one particle's prediction.
        threads: Threads of the measurement.
        num_particles: Fluid particles of the frame, mean.
    """

    ms_per_frame: float
    ms_low: float
    ms_high: float
    geometry_ms: float
    network_ms: float
    us_per_particle: float
    peak_mb: float
    flops_per_particle: float
    threads: int
    num_particles: float


def measure_costs(
    models: Mapping[str, Path],
    load: Callable[[Path], FieldModel],
    inputs: Sequence[Inputs],
    *,
    threads: int,
    repeats: int,
) -> dict[str, Cost]:
    """Cost of each model on the same frames.

    The models take turns, so that a change of the machine's speed meets all of them alike; one round is a warm-up.

    Args:
        models: Checkpoint folder of each model.
        load: Reads a checkpoint folder.
        inputs: Frames to predict, in turn.
        threads: Torch threads.
        repeats: Timed predictions of each model.
    """
    loaded = {name: load(path) for name, path in models.items()}
    with _threads(threads):
        times = _times_in_turn({name: (model, inputs) for name, model in loaded.items()}, repeats)
    particles = statistics.fmean(frame.num_particles for frame in inputs)
    costs = {}
    for name, model in loaded.items():
        medians = _medians(times[name])
        costs[name] = Cost(
            **medians,
            us_per_particle=1e3 * medians["ms_per_frame"] / max(particles, 1),
            peak_mb=_peak_megabytes(load, models[name], inputs[0], threads),
            flops_per_particle=flops_per_particle(model, inputs[0]),
            threads=threads,
            num_particles=particles,
        )
    return costs


def measure_analytic(
    states: Sequence[FluidState], box: Box, field: Callable, kernel, *, threads: int, repeats: int
) -> dict[str, float]:
    """Time of the analytic field itself, neighbour search within the kernel's support included, densities given.

    Args:
        states: Fluid of the frames to compute it on, in turn, in the precision of the networks.
        box: Their box.
        field: State and kernel to the field (N, C).
        kernel: SPH kernel.
        threads: Torch threads.
        repeats: Timed frames.

    Returns:
        "ms_per_frame", "ms_low", "ms_high", "geometry_ms" (neighbours) and "network_ms" (the field).
    """
    times = []
    with _threads(threads):
        for repeat in range(repeats + 1):
            state = states[repeat % len(states)]
            start = time.perf_counter()
            state = replace(state, edges=radius_graph(state.positions, kernel.support_radius, box))
            middle = time.perf_counter()
            field(state, kernel)
            times.append((middle - start, time.perf_counter() - middle))
    return _medians(times[1:])


@dataclass(frozen=True, kw_only=True)
class FrameTime:
    """Time of predicting a frame of some size.

    Attributes:
        num_particles: Fluid particles.
        ms_per_frame: Median time, ms.
        ms_low: Lower quartile.
        ms_high: Upper quartile.
        geometry_ms: Median time of neighbour search and geometry.
        network_ms: Median time of the network alone.
    """

    num_particles: int
    ms_per_frame: float
    ms_low: float
    ms_high: float
    geometry_ms: float
    network_ms: float


@dataclass(frozen=True, kw_only=True)
class Growth:
    """How the time of a frame grows with the number of particles.

    Attributes:
        times: Time at each size that was measured, ascending.
        exponent: Slope of time over number in logarithms, by least squares; NaN from a single size.
        left_out: Sizes that would have taken too long.
    """

    times: tuple[FrameTime, ...]
    exponent: float
    left_out: tuple[int, ...]


def measure_growth(
    models: Mapping[str, Path],
    load: Callable[[Path], FieldModel],
    *,
    sizes: Sequence[int] = (1000, 3000, 10_000, 30_000, 100_000),
    threads: int,
    repeats: int,
    max_seconds: float = 3.0,
) -> dict[str, Growth]:
    """Time of each model on blocks of fluid of growing size, with the particle spacing that the model is for.

    The models take turns; one round at each size is a warm-up. A model whose frame takes longer than `max_seconds` is
    not measured at larger sizes.

    Args:
        models: Checkpoint folder of each model.
        load: Reads a checkpoint folder.
        sizes: Numbers of fluid particles, ascending.
        threads: Torch threads.
        repeats: Timed predictions of each model and size, at least 2.
        max_seconds: Longest median time of a frame after which a model goes on.
    """
    loaded = {name: load(path) for name, path in models.items()}
    measured: dict[str, list[FrameTime]] = {name: [] for name in loaded}
    with _threads(threads):
        for size in sizes:
            times = _times_in_turn(
                {
                    name: (model, [fluid_block(size, model.config)])
                    for name, model in loaded.items()
                    if not measured[name] or measured[name][-1].ms_per_frame <= 1e3 * max_seconds
                },
                repeats,
            )
            for name, samples in times.items():
                measured[name].append(FrameTime(num_particles=size, **_medians(samples)))
    return {
        name: Growth(times=tuple(times), exponent=_exponent(times), left_out=tuple(sizes[len(times) :]))
        for name, times in measured.items()
    }


def fluid_block(num_particles: int, field: FieldConfig, seed: int = 0) -> Inputs:
    """A cube of fluid in open space for a model: a jittered lattice with random velocities, on a layer of wall points.

    Args:
        num_particles: Fluid particles; the topmost layer of the cube is as full as they make it.
        field: What the model is for: dimensions, particle spacing, features of boundary points.
        seed: Seed of jitter and velocities.
    """
    dim, spacing = field.dim, field.particle_spacing
    generator = torch.Generator().manual_seed(seed)
    side = next(side for side in itertools.count(1) if side**dim >= num_particles)
    ticks = torch.arange(side) + 0.5
    lattice = torch.cartesian_prod(*[ticks] * dim).reshape(-1, dim)
    jitter = 0.2 * (torch.rand(num_particles, dim, generator=generator) - 0.5)
    ones = torch.ones(num_particles, 1)
    velocities = torch.randn(num_particles, dim, generator=generator)
    walls, normals = None, None
    if field.boundary_channels:  # below the first axis, along which the cube fills up
        walls = lattice[: side ** (dim - 1)] - torch.eye(dim)[0]
        normals = torch.eye(dim)[:1] if field.boundary_channels == dim else torch.ones(1, field.boundary_channels)
        normals = normals.repeat(len(walls), 1)
    return Inputs(
        positions=spacing * (lattice[:num_particles] + jitter),
        features=torch.cat([ones, velocities, ones], dim=1),
        boundary_positions=None if walls is None else spacing * walls,
        boundary_features=normals,
        box=Box([0] * dim, [spacing * side] * dim),
    )


def flops_per_particle(model: FieldModel, inputs: Inputs) -> float:
    """Multiplications and additions of one particle's prediction, as `cost_model` counts them for the given frame."""
    config = model.config
    return estimate(
        config.network.model_dump(),
        dim=config.dim,
        vector_output=config.task in VECTOR_TASKS,
        boundary_channels=config.boundary_channels,
        surroundings=surroundings_of(inputs, config.network.relative_cutoff, config.particle_spacing),
    ).flops_per_particle


def surroundings_of(inputs: Inputs, relative_cutoff: float, particle_spacing: float) -> Surroundings:
    """Points around the particles of a frame, counted within a cutoff in particle spacings."""
    cutoff, particles = relative_cutoff * particle_spacing, max(inputs.num_particles, 1)
    counts = [len(radius_graph(inputs.positions, cutoff, inputs.box)) / particles]
    if inputs.boundary_positions is not None:
        walls = inputs.boundary_positions
        pairs = radius_graph(walls, cutoff, inputs.box, queries=inputs.positions)
        counts += [len(pairs) / particles, len(walls) / particles]
    return Surroundings.counted(relative_cutoff, inputs.positions.shape[1], *counts)


def _times_in_turn(
    models: Mapping[str, tuple[FieldModel, Sequence[Inputs]]], repeats: int
) -> dict[str, list[tuple[float, float]]]:
    """Times of geometry and network of each model on its frames, s; the first of its turns is left out."""
    times = {name: [] for name in models}
    for repeat in range(repeats + 1):
        for name, (model, frames) in models.items():
            times[name].append(_time_prediction(model, frames[repeat % len(frames)]))
    return {name: samples[1:] for name, samples in times.items()}


@torch.no_grad()
def _time_prediction(model: FieldModel, inputs: Inputs) -> tuple[float, float]:
    start = time.perf_counter()
    geometry = model.geometry(inputs)
    middle = time.perf_counter()
    model(inputs, geometry)
    return middle - start, time.perf_counter() - middle


def _medians(times: Sequence[tuple[float, float]]) -> dict[str, float]:
    """Times of frames with their quartiles, ms, by their names in `Cost` and `FrameTime`."""
    low, median, high = statistics.quantiles((1e3 * (geometry + network) for geometry, network in times), n=4)
    return {
        "ms_per_frame": median,
        "ms_low": low,
        "ms_high": high,
        "geometry_ms": 1e3 * statistics.median(geometry for geometry, _ in times),
        "network_ms": 1e3 * statistics.median(network for _, network in times),
    }


def _exponent(times: Sequence[FrameTime]) -> float:
    if len(times) < 2:
        return math.nan
    sizes, medians = zip(*((time.num_particles, time.ms_per_frame) for time in times), strict=True)
    return statistics.linear_regression([math.log(n) for n in sizes], [math.log(ms) for ms in medians]).slope


def _peak_megabytes(load: Callable[[Path], FieldModel], path: Path, inputs: Inputs, threads: int) -> float:
    """Growth of the peak memory of a fresh process by two predictions."""
    with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as pool:
        return pool.submit(_memory_of_predictions, load, path, inputs, threads).result()


def _memory_of_predictions(load: Callable[[Path], FieldModel], path: Path, inputs: Inputs, threads: int) -> float:
    torch.set_num_threads(threads)
    model = load(path)
    before = _peak_resident_megabytes()
    for _ in range(2):
        model.predict(inputs)
    return _peak_resident_megabytes() - before


def _peak_resident_megabytes() -> float:
    """Peak memory of this process. On Linux `getrusage` would hand on the parent's peak, so /proc is asked."""
    status = Path("/proc/self/status")
    if not status.is_file():
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
    line = next(line for line in status.read_text().splitlines() if line.startswith("VmHWM"))
    return int(line.split()[1]) / 1024


@contextmanager
def _threads(count: int):
    before = torch.get_num_threads()
    torch.set_num_threads(count)
    try:
        yield
    finally:
        torch.set_num_threads(before)
