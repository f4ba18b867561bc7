"""The measured cost of a model: alone on the machine, with fixed threads, next to a reference in the same run."""

import itertools
import math
import random
import statistics
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import torch

from cconv.data.trajectory import Boundary, Frame, ParticleType, Scene
from cconv.data.window import Window
from cconv.devices import name_of, wait_for
from cconv.domain import Box
from cconv.evaluation.memory import device_megabytes, peak_megabytes
from cconv.models.model import Model, ModelConfig
from cconv.neighbors import radius_graph
from cconv.networks.counting import CountedCost, NeighborDensity
from cconv.ops.workers import torch_threads
from cconv.rollout.correctors import correctors_of
from cconv.sph.compiled import CompiledSums
from cconv.tasks import task_named
from cconv.tasks.features import FluidState
from cconv.tasks.inputs import Inputs
from cconv.tasks.task import FieldTask, StepTask, Task, as_field

ANALYTIC = "analytic SPH"  # its name among the models that it is timed in turn with

# Times of the geometry and of the rest of one prediction, s, given the number of the turn.
Call = Callable[[int], tuple[float, float]]


@dataclass(frozen=True, kw_only=True)
class Cost:
    """Cost of predicting one frame as a user does, by `predict_frame`.

    The time covers everything from the particles of a stored frame to the field in the units of the data: features,
    the sum of densities if the model takes it, neighbour search, geometry and network.

    Attributes:
        ms_per_frame: Median time of a frame, ms.
        ms_low: Lower quartile.
        ms_high: Upper quartile.
        geometry_ms: Median time of everything except the network: features, densities, neighbours, geometry.
        network_ms: Median time of the network alone.
        turns_ms: Time of each turn, ms; in the same turn all models that are timed together predict the same frame.
        us_per_particle: Median time over the number of fluid particles, µs.
        peak_mb: Largest memory that predictions add to a fresh process, MB.
        flops_per_particle: Multiplications and additions of a prediction per particle.
        threads: Number of threads of the measurement.
        num_particles: Mean number of fluid particles of a frame.
        device: Where models were timed, on frames that stood there.
    """

    ms_per_frame: float
    ms_low: float
    ms_high: float
    geometry_ms: float
    network_ms: float
    turns_ms: tuple[float, ...]
    us_per_particle: float
    peak_mb: float
    flops_per_particle: float
    threads: int
    num_particles: float
    device: str = "cpu"


@dataclass(frozen=True, kw_only=True)
class AnalyticCost:
    """Cost of the analytic field of one frame: neighbour search, and compiled sums over the pairs.

    The density gradient sums the densities first, as a user has to.

    Attributes:
        ms_per_frame: Median time of a frame, ms.
        ms_low: Lower quartile.
        ms_high: Upper quartile.
        geometry_ms: Median time of the neighbour search.
        network_ms: Median time of the sums.
        turns_ms: Time of each turn, ms, as in `Cost`.
    """

    ms_per_frame: float
    ms_low: float
    ms_high: float
    geometry_ms: float
    network_ms: float
    turns_ms: tuple[float, ...]


def measure_costs(
    models: Mapping[str, Path],
    load: Callable[[Path], Model],
    frames: Sequence[Frame] | Sequence[Window],
    scene: Scene,
    *,
    task: Task,
    threads: int,
    repeats: int,
) -> tuple[dict[str, Cost], AnalyticCost | None]:
    """Measure the cost of each model and of the analytic field, if the task is one, on the same frames.

    They take turns, so that a change of the machine's speed affects all of them alike. Each turn has a random order,
    and the first one is a warm-up.

    Args:
        models: Checkpoint folder of each model.
        load: Reads a checkpoint folder.
        frames: Frames, or windows of a step task, to predict from in turn.
        scene: Their scene.
        task: Task of the models.
        threads: Number of torch threads.
        repeats: Timed predictions of each model, at least 2.
    """
    loaded = {name: load(path) for name, path in models.items()}
    calls = {name: _model_call(model, frames, scene) for name, model in loaded.items()}
    if isinstance(task, FieldTask):
        calls[ANALYTIC] = _analytic_call(task, frames, scene)
    with torch_threads(threads):
        times = _times_in_turn(calls, repeats)
    peaks = _peaks(loaded, load, models, frames[0], scene, threads)
    particles = statistics.fmean(_num_fluid(frame) for frame in frames)
    costs = {}
    for name, model in loaded.items():
        medians = _medians(times[name])
        costs[name] = Cost(
            **medians,
            turns_ms=_turns(times[name]),
            us_per_particle=1e3 * medians["ms_per_frame"] / max(particles, 1),
            peak_mb=peaks[name],
            flops_per_particle=flops_per_particle(model, model.inputs(frames[0], scene)),
            threads=threads,
            num_particles=particles,
            device=name_of(model.device),
        )
    analytic = times.get(ANALYTIC)
    return costs, None if analytic is None else AnalyticCost(**_medians(analytic), turns_ms=_turns(analytic))


def _peaks(
    loaded: Mapping[str, Model],
    load: Callable[[Path], Model],
    models: Mapping[str, Path],
    frame: Frame | Window,
    scene: Scene,
    threads: int,
) -> dict[str, float]:
    """Memory that a prediction of each model adds: to what a GPU holds already, elsewhere to a fresh process."""
    if all(model.device.type == "cuda" for model in loaded.values()):
        return {name: device_megabytes(model, frame, scene) for name, model in loaded.items()}
    return peak_megabytes(load, models, frame, scene, threads)


@dataclass(frozen=True, kw_only=True)
class FrameTime:
    """Time of predicting a frame of a given size.

    Attributes:
        num_particles: Fluid particles.
        ms_per_frame: Median time, ms.
        ms_low: Lower quartile.
        ms_high: Upper quartile.
        geometry_ms: Median time of everything except the network.
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
    """Growth of the time of a frame with the number of particles.

    Attributes:
        times: Time at each size that was measured, ascending.
        exponent: Slope of log time against log number of particles, by least squares; NaN for a single size.
        left_out: Sizes that would have taken too long.
    """

    times: tuple[FrameTime, ...]
    exponent: float
    left_out: tuple[int, ...]


def measure_growth(
    models: Mapping[str, Path],
    load: Callable[[Path], Model],
    *,
    analytic: ModelConfig | None = None,
    sizes: Sequence[int] = (1000, 3000, 10_000, 30_000, 100_000),
    threads: int,
    repeats: int,
    max_seconds: float = 3.0,
) -> dict[str, Growth]:
    """Time each model on blocks of fluid of growing size, with the particle spacing that the model was trained for.

    The models take turns; one round at each size is a warm-up. A model whose frame takes longer than `max_seconds` is
    not measured at larger sizes.

    Args:
        models: Checkpoint folder of each model.
        load: Reads a checkpoint folder.
        analytic: Configuration of the field that is also summed analytically in turn with the models, named `ANALYTIC`;
            nothing is summed for that of a step.
        sizes: Numbers of fluid particles, ascending.
        threads: Number of torch threads.
        repeats: Timed predictions of each model and size, at least 2.
        max_seconds: Largest median time of a frame after which a model is still timed at the next size.
    """
    callers = {name: partial(_block_call, load(path)) for name, path in models.items()}
    if analytic is not None and isinstance(analytic.asked, FieldTask):
        callers[ANALYTIC] = partial(_analytic_block_call, analytic)
    measured: dict[str, list[FrameTime]] = {name: [] for name in callers}
    with torch_threads(threads):
        for size in sizes:
            going_on = {
                name: call_of(size)
                for name, call_of in callers.items()
                if not measured[name] or measured[name][-1].ms_per_frame <= 1e3 * max_seconds
            }
            for name, times in _times_in_turn(going_on, repeats).items():
                measured[name].append(FrameTime(num_particles=size, **_medians(times)))
    return {
        name: Growth(times=tuple(times), exponent=_exponent(times), left_out=tuple(sizes[len(times) :]))
        for name, times in measured.items()
    }


def fluid_block(num_particles: int, field: ModelConfig, seed: int = 0) -> tuple[Frame, Scene]:
    """Make a cube of fluid in open space: a jittered lattice with random velocities, on a layer of walls.

    Walls are points or particles at rest, as the model was trained beside them.

    Args:
        num_particles: Number of fluid particles; the topmost layer of the cube may be incomplete.
        field: Configuration of the model: dimensions, particle spacing, features of boundary points, types of walls.
        seed: Seed of jitter and velocities.
    """
    dim, spacing = field.dim, field.particle_spacing
    generator = torch.Generator().manual_seed(seed)
    side = next(side for side in itertools.count(1) if side**dim >= num_particles)
    ticks = torch.arange(side) + 0.5
    lattice = torch.cartesian_prod(*[ticks] * dim).reshape(-1, dim)
    jitter = 0.2 * (torch.rand(num_particles, dim, generator=generator) - 0.5)
    layer = lattice[: side ** (dim - 1)] - torch.eye(dim)[0]  # below the first axis, along which the cube fills up
    kinds = torch.tensor([*itertools.islice(itertools.cycle(field.wall_types), len(layer))], dtype=torch.int64)
    walls = layer[: len(kinds)]  # particles of each type in turn; none where the model knows no type
    boundary = None
    if field.walls:
        normals = torch.eye(dim)[:1].expand_as(layer).clone() if field.walls.vectors else None
        boundary = Boundary(positions=spacing * layer, normals=normals)
    velocities = torch.randn(num_particles, dim, generator=generator)
    frame = Frame(
        positions=spacing * torch.cat([lattice[:num_particles] + jitter, walls]),
        velocities=torch.cat([velocities, torch.zeros_like(walls)]),
        masses=torch.full((num_particles + len(walls),), spacing**dim),
        particle_types=torch.cat([torch.full((num_particles,), int(ParticleType.FLUID)), kinds]),
        boundary=boundary,
    )
    return frame, _block_scene(field, side)


def _block_scene(field: ModelConfig, side: int) -> Scene:
    dim, spacing = field.dim, field.particle_spacing
    return Scene(
        name="block",
        dim=dim,
        particle_spacing=spacing,
        frame_dt=1.0,
        box=Box([0] * dim, [spacing * side] * dim),
        force=None,
        has_boundary=field.walls is not None,
        velocity_source="stored",
        mass_source="stored",
        missing=(),
    )


def flops_per_particle(model: Model, inputs: Inputs) -> float:
    """Count the multiplications and additions of a prediction per particle, from settings and a frame."""
    return counted_cost(model.config, inputs).flops_per_particle


def counted_cost(config: ModelConfig, inputs: Inputs) -> CountedCost:
    """Count the cost of a prediction per particle, that of the predictor included, from settings and a frame."""
    around = neighbor_density(inputs, config.network.relative_cutoff)
    counted = config.network.count(config.inputs, config.walls, config.output, config.dim, around)
    return counted if config.predictor is None else counted + counted_cost(config.predictor, inputs)


def neighbor_density(inputs: Inputs, relative_cutoff: float) -> NeighborDensity:
    """Count the points around the particles of a frame within a cutoff in particle spacings."""
    particles = max(inputs.num_particles, 1)
    counts = [len(radius_graph(inputs.positions, relative_cutoff, inputs.box)) / particles]
    if inputs.wall_positions is not None:
        walls = inputs.wall_positions
        pairs = radius_graph(walls, relative_cutoff, inputs.box, queries=inputs.positions)
        counts += [len(pairs) / particles, len(walls) / particles]
    return NeighborDensity.counted(relative_cutoff, inputs.dim, *counts)


def _times_in_turn(calls: Mapping[str, Call], repeats: int) -> dict[str, list[tuple[float, float]]]:
    """Time geometry and network of each call in turn, s, without the first turn.

    The order of the calls changes in each turn, because a call inherits the caches of the one before it.
    """
    times: dict[str, list[tuple[float, float]]] = {name: [] for name in calls}
    orders = random.Random(0)
    for turn in range(repeats + 1):
        for name in orders.sample(list(calls), len(calls)):
            times[name].append(calls[name](turn))
    return {name: samples[1:] for name, samples in times.items()}


def _model_call(model: Model, frames: Sequence[Frame] | Sequence[Window], scene: Scene) -> Call:
    placed = [frame.to(model.home) for frame in frames]
    return lambda turn: _time_prediction(model, placed[turn % len(placed)], scene)


def _analytic_call(task: FieldTask, frames: Sequence[Any], scene: Scene) -> Call:
    sums = CompiledSums(task.kernel_at(scene.particle_spacing, scene.dim))
    return lambda turn: _time_analytic(task, sums, frames[turn % len(frames)], scene)


def _block_call(model: Model, size: int) -> Call:
    frame, scene = fluid_block(size, model.config)
    if isinstance(model.task, StepTask):
        return _model_call(model, [_at_constant_velocity(frame, scene, model.task.history)], scene)
    return _model_call(model, [frame], scene)


def _analytic_block_call(field: ModelConfig, size: int) -> Call:
    frame, scene = fluid_block(size, field)
    task = as_field(task_named(field.task, field.kernel, field.relative_smoothing_length))
    return _analytic_call(task, [frame], scene)


def _at_constant_velocity(frame: Frame, scene: Scene, history: int) -> Window:
    """Make the window of frames that end with a frame, before which its particles moved at a tenth of their velocity.

    A cube of fluid with random velocities of a spacing per frame would otherwise have left its place.
    """
    times = torch.arange(1 - history, 1)[:, None, None]
    return Window(
        positions=frame.positions + 0.1 * scene.particle_spacing * times * frame.velocities,
        future=frame.positions[None][:0],
        masses=frame.masses,
        particle_types=frame.particle_types,
        boundary=frame.boundary,
        trajectory=scene.name,
        frame=history - 1,
    )


def _time_prediction(model: Model, frame: Frame | Window, scene: Scene) -> tuple[float, float]:
    """Time a prediction outside the network and inside it; what corrects a rollout of the model counts outside.

    The device has done all its work before the clock is read.
    """
    marks = []

    def read_clock(*_: Any) -> None:
        wait_for(model.device)
        marks.append(time.perf_counter())

    hooks = [
        model.network.register_forward_pre_hook(read_clock),
        model.network.register_forward_hook(read_clock),
    ]
    read_clock()
    model.predict_frame(frame, scene)
    if isinstance(frame, Window):
        for corrector in correctors_of(model):
            corrector(frame, frame, scene)
    read_clock()
    for hook in hooks:
        hook.remove()
    start, before, after, end = marks
    return end - start - (after - before), after - before


def _time_analytic(task: FieldTask, sums: CompiledSums, frame: Frame, scene: Scene) -> tuple[float, float]:
    """Time the neighbour search, including the selection of the fluid, and the sums."""
    start = time.perf_counter()
    fluid = frame.particle_types == ParticleType.FLUID
    masses, positions, velocities = (values[fluid] for values in (frame.masses, frame.positions, frame.velocities))
    state = FluidState(positions=positions, velocities=velocities, masses=masses, box=scene.box, kernel=sums.kernel)
    state.edges  # noqa: B018, searched here
    middle = time.perf_counter()
    task.compiled_field(sums, state)
    return middle - start, time.perf_counter() - middle


def _num_fluid(frame: Frame | Window) -> int:
    return int((frame.particle_types == ParticleType.FLUID).sum())


def _turns(times: Sequence[tuple[float, float]]) -> tuple[float, ...]:
    return tuple(1e3 * (geometry + network) for geometry, network in times)


def _medians(times: Sequence[tuple[float, float]]) -> dict[str, float]:
    """Summarise times as medians and quartiles, ms, by their names in `Cost` and `FrameTime`."""
    low, median, high = statistics.quantiles(_turns(times), n=4, method="inclusive")
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
