"""What a model costs: measured alone, with a fixed number of threads, always next to a reference in the same run."""

import resource
import statistics
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from multiprocessing import get_context
from pathlib import Path

import torch
from torch import Tensor, nn

from cconv.data.features import Inputs
from cconv.nn import ContinuousConv, ConvGeometry, RadialConv, RadialGeometry
from cconv.nn.radial_net import VectorLinear
from cconv.ops import general
from cconv.ops.filter_reads import FilterReads
from cconv.training.field_model import FieldModel


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
        times = {name: [] for name in loaded}
        for repeat in range(repeats + 1):
            frame = inputs[repeat % len(inputs)]
            for name, model in loaded.items():
                sample = _time_prediction(model, frame)
                if repeat > 0:
                    times[name].append(sample)
    return {
        name: _summary(
            times[name],
            peak_mb=_peak_megabytes(load, models[name], inputs[0], threads),
            flops=flops_per_particle(model, inputs[0]),
            threads=threads,
            num_particles=statistics.fmean(frame.num_particles for frame in inputs),
        )
        for name, model in loaded.items()
    }


def flops_per_particle(model: FieldModel, inputs: Inputs) -> float:
    """Multiplications and additions of one particle's prediction, counted from layer sizes and mean neighbours.

    A convolution gathers C_in values into the cells that an edge reads and multiplies K^D · C_in · C_out values a
    particle; where C_out is much smaller than C_in, it multiplies first and reads C_out values an edge and cell.
    """
    geometry, network = model.geometry(inputs), model.network
    total = sum(_conv_flops(conv, geometry.fluid) for conv in network.convs)
    if network.boundary_conv is not None:
        total += _conv_flops(network.boundary_conv, geometry.boundary)
    dense = sum(_dense_flops(layer) for layer in network.dense)
    return total / max(inputs.num_particles, 1) + dense


def _conv_flops(conv: ContinuousConv | RadialConv, geometry: ConvGeometry | RadialGeometry) -> float:
    if isinstance(conv, ContinuousConv):
        return _read_flops(geometry.reads, conv.filters.flatten(0, -3))
    vectors = conv.dim * _read_flops(geometry.reads, conv.vector_filters)
    return _read_flops(geometry.reads, conv.scalar_filters) + vectors


def _read_flops(reads: FilterReads, filters: Tensor) -> float:
    in_channels, out_channels = filters.shape[1:]
    if out_channels == 0:
        return 0.0
    multiplies_first = general.multiplies_first(reads.num_senders, reads.num_receivers, in_channels, out_channels)
    read = len(reads.senders) * reads.num_corners * (out_channels if multiplies_first else in_channels)
    multiplied = (reads.num_senders if multiplies_first else reads.num_receivers) * filters.numel()
    return 2.0 * (read + multiplied)


def _dense_flops(layer: nn.Linear | VectorLinear) -> float:
    if isinstance(layer, nn.Linear):
        return 2.0 * layer.weight.numel()
    return 2.0 * (layer.scalar_weights.numel() + layer.dim * layer.vector_weights.numel())


@torch.no_grad()
def _time_prediction(model: FieldModel, inputs: Inputs) -> tuple[float, float]:
    start = time.perf_counter()
    geometry = model.geometry(inputs)
    middle = time.perf_counter()
    model(inputs, geometry)
    return middle - start, time.perf_counter() - middle


def _summary(
    times: Sequence[tuple[float, float]], *, peak_mb: float, flops: float, threads: int, num_particles: float
) -> Cost:
    whole = [1e3 * (geometry + network) for geometry, network in times]
    low, median, high = statistics.quantiles(whole, n=4)
    return Cost(
        ms_per_frame=median,
        ms_low=low,
        ms_high=high,
        geometry_ms=1e3 * statistics.median(geometry for geometry, _ in times),
        network_ms=1e3 * statistics.median(network for _, network in times),
        us_per_particle=1e3 * median / max(num_particles, 1),
        peak_mb=peak_mb,
        flops_per_particle=flops,
        threads=threads,
        num_particles=num_particles,
    )


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
