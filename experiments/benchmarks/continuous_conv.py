"""Time and memory of continuous convolutions: ours, Open3D's and the bare matrix products, in turn on the same tensors.

    pip install -e '.[parity]'
    python experiments/benchmarks/continuous_conv.py --out runs/benchmarks [--data FOLDER]

Prints the ratios that the project holds itself to, and writes `targets.csv` (what they are of), `sweeps.csv` (median
and quartiles over sizes) and `sweeps.png`. Variants take turns within one process, so that a change of the machine's
speed meets all of them alike. Without Open3D its columns are left out. The training step needs a folder that
`cconv.open_dataset` reads.
"""

import argparse
import ctypes
import math
import os
import statistics
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from importlib.util import find_spec
from itertools import pairwise
from multiprocessing import get_context
from pathlib import Path

import matplotlib.pyplot as plt
import pandas as pd
import seaborn as sns
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from cconv import open_dataset, radius_graph
from cconv.models.model import build_model
from cconv.neighbors import Edges
from cconv.networks import ConvNetSettings
from cconv.nn import ConvGeometry, continuous_conv
from cconv.ops import general
from cconv.tasks import task_named
from cconv.tasks.samples import make_sample

HAS_OPEN3D = find_spec("open3d") is not None
QUANTITIES = ("forward", "forward + backward")
COLORS = {"ours": "C0", "general path": "C1", "Open3D": "C2", "matrix products": "C3"}


@dataclass(frozen=True, kw_only=True)
class Case:
    """A layer on points drawn evenly from the unit cube; the defaults are those of the targets."""

    num_particles: int = 4000
    neighbors: int = 25
    kernel_size: int = 4
    in_channels: int = 96
    out_channels: int = 64
    threads: int = 2


SWEEPS = {
    "num_particles": [Case(num_particles=count) for count in (1000, 2000, 4000, 8000, 16000)],
    "neighbors": [Case(neighbors=count) for count in (10, 25, 50, 80)],
    "kernel_size": [Case(kernel_size=size) for size in (2, 3, 4, 6, 8)],
    "channels": [
        Case(in_channels=inputs, out_channels=outputs)
        for inputs, outputs in ((4, 32), (16, 16), (32, 32), (64, 64), (96, 64), (64, 1))
    ],
    "threads": [Case(threads=threads) for threads in (1, 2)],
}


@dataclass(frozen=True, kw_only=True)
class Plan:
    """What is measured.

    Attributes:
        case: Layer of the targets.
        sweeps: Layers by what varies among them.
        counts: Particles of layers whose memory is measured; the last is that of the target.
        seconds: Measuring time of each case and quantity.
    """

    case: Case
    sweeps: Mapping[str, Sequence[Case]]
    counts: tuple[int, ...]
    seconds: float


def whole_plan(seconds: float) -> Plan:
    return Plan(case=Case(), sweeps=SWEEPS, counts=(4000, 20_000, 100_000), seconds=seconds)


def smoke_plan() -> Plan:
    """Layers too small for their figures to mean anything, to see that the script runs."""
    tiny = Case(num_particles=60, neighbors=5, kernel_size=2, in_channels=4, out_channels=3, threads=1)
    return Plan(case=tiny, sweeps={name: [tiny] for name in SWEEPS}, counts=(200,), seconds=0.0)


def edges_with(positions: Tensor, neighbors: int) -> Edges:
    """Edges of the cutoff that gives so many neighbours on average."""
    inside = (3 * neighbors / (4 * math.pi * len(positions))) ** (1 / 3)  # points near the walls see fewer
    low, high = inside, 1.6 * inside
    for _ in range(12):
        cutoff = (low + high) / 2
        edges = radius_graph(positions, cutoff)
        low, high = (low, cutoff) if len(edges) > neighbors * len(positions) else (cutoff, high)
    return edges


class Layer:
    """A layer of a case, computed in every way."""

    def __init__(self, case: Case):
        generator = torch.Generator().manual_seed(0)
        self.positions = torch.rand(case.num_particles, 3, generator=generator)
        self.edges = edges_with(self.positions, case.neighbors)
        self.geometry = ConvGeometry(self.edges, case.kernel_size)
        shape = (*(case.kernel_size,) * 3, case.in_channels, case.out_channels)
        self.features = torch.randn(case.num_particles, case.in_channels, generator=generator).requires_grad_()
        self.filters = torch.randn(shape, generator=generator).requires_grad_()
        self.gradient = torch.randn(case.num_particles, case.out_channels, generator=generator)

    def ours(self) -> Tensor:
        return continuous_conv(self.features, self.filters, self.geometry)

    def general(self) -> Tensor:
        return general.gather_then_multiply(self.features, self.filters.flatten(0, 2), self.geometry.reads, 0)

    def open3d(self) -> Tensor:
        from open3d.ml.torch.ops import continuous_conv as open3d_conv

        edges = self.edges
        return open3d_conv(
            filters=self.filters,
            out_positions=self.positions,
            extents=torch.tensor([[2 * edges.cutoff]]),
            offset=torch.zeros(3),
            inp_positions=self.positions,
            inp_features=self.features,
            inp_importance=torch.empty(0),
            neighbors_index=self.edges.senders.int(),
            neighbors_importance=(1 - (edges.distances / edges.cutoff) ** 2) ** 3,
            neighbors_row_splits=self.edges.row_splits,
            align_corners=True,
            coordinate_mapping="ball_to_cube_volume_preserving",
            normalize=False,
            interpolation="linear",
            max_temp_mem_MB=64,
        )

    def products(self) -> dict[str, Callable[[], None]]:
        """The matrix products alone, on columns that lie ready: what no order of the work can avoid."""
        filters = self.filters.detach().flatten(0, 3)
        columns = torch.randn(len(self.positions), len(filters))
        output, of_filters, of_columns = torch.empty_like(self.gradient), torch.empty_like(filters), torch.empty(0)

        def forward() -> None:
            torch.mm(columns, filters, out=output)

        def forward_backward() -> None:
            forward()
            torch.mm(columns.T, self.gradient, out=of_filters)
            torch.mm(self.gradient, filters.T, out=of_columns.resize_(columns.shape))

        return dict(zip(QUANTITIES, (forward, forward_backward), strict=True))

    def calls(self, compute: Callable[[], Tensor]) -> dict[str, Callable[[], None]]:
        @torch.no_grad()
        def forward() -> None:
            compute()

        def forward_backward() -> None:
            torch.autograd.grad(compute(), (self.features, self.filters), self.gradient)

        return dict(zip(QUANTITIES, (forward, forward_backward), strict=True))


class Open3DNet(nn.Module):
    """The published ConvNet in Open3D's layers, each of which searches its neighbours, as the published code does."""

    def __init__(self, in_channels: int, boundary_channels: int, out_channels: int):
        from open3d.ml.torch.layers import ContinuousConv

        super().__init__()
        layer = partial(
            ContinuousConv, kernel_size=[4, 4, 4], coordinate_mapping="ball_to_cube_volume_preserving",
            normalize=False, window_function=lambda squared: ((1 - squared) ** 3).clamp(0, 1),
            radius_search_ignore_query_points=True,
        )  # fmt: skip
        widths = list(pairwise((96, 64, 64, out_channels)))
        self.fluid = layer(in_channels=in_channels, filters=32)
        self.boundary = layer(in_channels=boundary_channels, filters=32)
        self.first_dense = nn.Linear(in_channels, 32)
        self.convs = nn.ModuleList(layer(in_channels=inputs, filters=outputs) for inputs, outputs in widths)
        self.dense = nn.ModuleList(nn.Linear(inputs, outputs) for inputs, outputs in widths)

    def forward(self, features: Tensor, positions: Tensor, normals: Tensor, walls: Tensor, extent: float) -> Tensor:
        from_walls = self.boundary(normals, walls, positions, extent)
        from_fluid = self.fluid(features, positions, positions, extent)
        output = torch.cat([from_walls, from_fluid, self.first_dense(features)], dim=1)
        for conv, dense in zip(self.convs, self.dense, strict=True):
            activated = F.relu(output)
            added = conv(activated, positions, positions, extent) + dense(activated)
            output = added + output if added.shape == output.shape else added
        return output


def training_steps(folder: Path) -> dict[str, Callable[[], None]]:
    """One training step each of the published network on a frame, neighbour search included."""
    dataset = open_dataset(folder, mass=0.125, particle_spacing=0.05, frame_dt=1 / 60)
    task = task_named("density_rate")
    sample = make_sample(dataset.trajectory("train", 0)[20], dataset.scene, task)
    model = build_model(ConvNetSettings(), task, task.features, dataset.scene, [sample])
    inputs, target = sample.inputs, model.standardize_target(sample.target)

    def step(parameters: nn.Module, optimizer: torch.optim.Optimizer, predict: Callable[[], Tensor]) -> None:
        optimizer.zero_grad()
        F.mse_loss(predict(), target).backward()
        optimizer.step()

    steps = {"ours": partial(step, model, adam(model), lambda: model(inputs, model.geometry(inputs)))}
    if HAS_OPEN3D:
        fluid, walls = inputs.features.flat(), inputs.wall_features.flat()
        theirs = Open3DNet(fluid.shape[1], walls.shape[1], target.shape[1])
        features = (fluid - model.feature_mean) / model.feature_scale
        tensors = (features, inputs.positions, walls, inputs.wall_positions)
        steps["Open3D"] = partial(
            step, theirs, adam(theirs), lambda: theirs(*tensors, 2 * model.config.network.relative_cutoff)
        )
    return steps


def adam(module: nn.Module) -> torch.optim.Optimizer:
    return torch.optim.Adam(module.parameters(), lr=1e-3)


def in_turn(calls: dict[str, Callable[[], None]], seconds: float) -> dict[str, list[float]]:
    """Milliseconds of each call, one after the other, at least three times and until `seconds` have passed.

    Each is called twice and the second call is timed, after a pause in which the threads of the one before fall asleep:
    none pays for what another left in the caches or on the cores.
    """
    times: dict[str, list[float]] = {name: [] for name in calls}
    end = time.perf_counter() + seconds
    while time.perf_counter() < end or len(next(iter(times.values()))) < 3:
        for name, call in calls.items():
            time.sleep(0.02)
            call()
            start = time.perf_counter()
            call()
            times[name].append(1e3 * (time.perf_counter() - start))
    return times


def summary(times: dict[str, list[float]]) -> list[dict]:
    rows = []
    for variant, values in times.items():
        low, median, high = statistics.quantiles(values, n=4, method="inclusive")
        rows.append({"variant": variant, "ms": median, "low": low, "high": high, "repeats": len(values)})
    return rows


def measure_layer(case: Case, seconds: float, with_general: bool) -> list[dict]:
    """Times of a case, and how far its outputs lie apart; in a process of its own for the number of threads."""
    if case.threads < len(os.sched_getaffinity(0)):
        os.sched_setaffinity(0, sorted(os.sched_getaffinity(0))[: case.threads])  # Open3D takes every core it sees
    torch.set_num_threads(case.threads)
    layer = Layer(case)
    variants, outputs = {"ours": layer.calls(layer.ours)}, {"ours": layer.ours(), "general path": layer.general()}
    if with_general:
        variants["general path"] = layer.calls(layer.general)
    if HAS_OPEN3D:
        variants["Open3D"] = layer.calls(layer.open3d)
        outputs["Open3D"] = layer.open3d()
    variants["matrix products"] = layer.products()
    reference = outputs["Open3D" if HAS_OPEN3D else "general path"].detach()
    rows = []
    for quantity in QUANTITIES:
        times = in_turn({name: calls[quantity] for name, calls in variants.items()}, seconds)
        rows += [{"quantity": quantity, **vars(case), **row} for row in summary(times)]
    for row in rows:
        if row["variant"] in outputs:
            difference = (outputs[row["variant"]].detach() - reference).abs().max() / reference.abs().max()
            row["difference"] = float(difference)
    return rows


def measure_geometry(case: Case, seconds: float) -> list[dict]:
    """Times of what a layer needs before it: neighbour search, and the geometry that all layers share."""
    torch.set_num_threads(case.threads)
    layer = Layer(case)
    calls = {
        "neighbour search": lambda: radius_graph(layer.positions, layer.edges.cutoff),
        "geometry": lambda: ConvGeometry(layer.edges, case.kernel_size),
        "layer": layer.calls(layer.ours)["forward"],
    }
    return [{"quantity": "preparation", **vars(case), **row} for row in summary(in_turn(calls, seconds))]


def extra_megabytes(case: Case, variant: str) -> float:
    """Growth of a fresh process's peak memory by forward + backward, outputs and gradients taken off."""
    torch.set_num_threads(case.threads)
    small = Layer(replace(case, num_particles=100, neighbors=5))  # loads and starts what stays for the whole process
    small.calls(getattr(small, variant))["forward + backward"]()
    layer = Layer(case)
    ctypes.CDLL(None).malloc_trim(0)  # freed memory goes back to the system,
    Path("/proc/self/clear_refs").write_text("5")  # and the peak starts anew from what is held
    before = peak_bytes()
    output = getattr(layer, variant)()
    gradients = torch.autograd.grad(output, (layer.features, layer.filters), layer.gradient)
    return (peak_bytes() - before - sum(tensor.nbytes for tensor in (output, *gradients))) / 1e6


def peak_bytes() -> int:
    status = Path("/proc/self/status").read_text().splitlines()
    return 1024 * int(next(line for line in status if line.startswith("VmHWM")).split()[1])


def in_fresh_process(function: Callable, *arguments) -> object:
    with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as pool:
        return pool.submit(function, *arguments).result()


def measure_targets(data: Path | None, plan: Plan) -> pd.DataFrame:
    """What the ratios need, with many repeats and without the general path, which takes ten times as long."""
    rows = []
    for case in (plan.case, replace(plan.case, in_channels=min(64, plan.case.in_channels), out_channels=1)):
        rows += in_fresh_process(measure_layer, case, plan.seconds, False)
    rows += in_fresh_process(measure_geometry, plan.case, plan.seconds)
    rows += measure_memory(plan.counts[-1:])
    if data is not None:
        times = in_turn(training_steps(data), 5 * plan.seconds)
        rows += [{"quantity": "training step", **row} for row in summary(times)]
    return pd.DataFrame(rows)


def measure_sweeps(plan: Plan) -> pd.DataFrame:
    """All layers of the sweeps, and the memory over the number of particles."""
    rows = []
    for sweep, cases in plan.sweeps.items():
        for case in cases:
            print(f"{sweep}: {case}", flush=True)
            rows += [{"sweep": sweep, **row} for row in in_fresh_process(measure_layer, case, plan.seconds, True)]
    return pd.DataFrame(rows + [{"sweep": "memory", **row} for row in measure_memory(plan.counts)])


def measure_memory(counts: tuple[int, ...]) -> list[dict]:
    variants = {"ours": "ours", "Open3D": "open3d"} if HAS_OPEN3D else {"ours": "ours"}
    return [
        {"quantity": "memory", **vars(case), "variant": name, "MB": in_fresh_process(extra_megabytes, case, method)}
        for case in (Case(num_particles=count) for count in counts)
        for name, method in variants.items()
    ]


def ratios(table: pd.DataFrame, plan: Plan) -> pd.DataFrame:
    """The figures that the project holds itself to, with the bound of each."""
    table = table.reindex(columns=[*table.columns, *{"MB", "difference"} - set(table.columns)])

    def ms(variant: str, quantity: str, out_channels: int | None = None) -> float:
        rows = table[(table.variant == variant) & (table.quantity == quantity)]
        return (rows if out_channels is None else rows[rows.out_channels == out_channels]).ms.median()

    both, step, wide = "forward + backward", "training step", plan.case.out_channels
    memory = table[(table.quantity == "memory") & (table.variant == "ours")]
    rows = [
        ("96 to 64, forward + backward: Open3D / ours", ms("Open3D", both, wide) / ms("ours", both, wide), ">= 3"),
        ("the same: ours / matrix products", ms("ours", both, wide) / ms("matrix products", both, wide), "<= 1.5"),
        ("64 to 1, forward: Open3D / ours", ms("Open3D", "forward", 1) / ms("ours", "forward", 1), ">= 10"),
        ("ConvNet training step: Open3D / ours", ms("Open3D", step) / ms("ours", step), ">= 4"),
        ("geometry of 100,000 edges / layer", ms("geometry", "preparation") / ms("layer", "preparation"), "<= 1"),
        ("largest difference / largest value", table.loc[table.variant == "ours", "difference"].max(), "<= 1e-5"),
        ("extra memory at N = 100,000, MB", memory["MB"].max(), "<= 100"),
    ]
    return pd.DataFrame(rows, columns=["what", "measured", "target"])


def draw(table: pd.DataFrame, path: Path) -> None:
    """Time of forward + backward over each sweep, and memory over the number of particles."""
    sns.set_theme(style="whitegrid", context="paper")
    axes = {
        "num_particles": "particles",
        "neighbors": "neighbours",
        "kernel_size": "kernel size K",
        "threads": "threads",
    }
    figure, panels = plt.subplots(2, 3, figsize=(11, 6.4), layout="constrained")
    both = table[table.quantity == "forward + backward"].copy()
    both["channels"] = both.in_channels.map("{:.0f}".format) + "→" + both.out_channels.map("{:.0f}".format)
    for panel, (sweep, label) in zip(panels.flat, {**axes, "channels": "channels"}.items(), strict=False):
        rows = both[both.sweep == sweep]
        for variant, group in rows.groupby("variant", sort=False):
            errors = [group.ms - group.low, group.high - group.ms]
            panel.errorbar(
                group[sweep],
                group.ms,
                errors,
                marker="o",
                markersize=4,
                capsize=2,
                label=variant,
                color=COLORS[variant],
            )
        panel.set(xlabel=label, ylabel="forward + backward, ms", yscale="log")
        if sweep in ("num_particles", "neighbors", "kernel_size"):
            panel.set_xscale("log", base=2)
            ticks = sorted(rows[sweep].unique())
            panel.set_xticks(ticks, [f"{tick:.0f}" for tick in ticks])
            panel.minorticks_off()
        elif sweep == "threads":
            panel.set_xticks([1, 2])
    memory = panels.flat[5]
    for variant, group in table[table.sweep == "memory"].groupby("variant", sort=False):
        memory.plot(group.num_particles, group["MB"], marker="o", markersize=4, color=COLORS[variant])
    memory.set(xscale="log", xlabel="particles", ylabel="memory beyond inputs and outputs, MB")
    memory.set_ylim(bottom=0)
    panels.flat[0].legend(frameon=True)
    figure.suptitle("96 → 64 channels, 4,000 particles, 25 neighbours, K = 4, 3D, float32, two threads unless varied")
    figure.savefig(path, dpi=120)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("runs/benchmarks"), help="folder to write")
    parser.add_argument("--data", type=Path, help="DeepLagrangianFluids folder for the training step")
    parser.add_argument("--seconds", type=float, default=3.0, help="measuring time of each case and quantity")
    parser.add_argument("--targets-only", action="store_true", help="leave out the sweeps, which take some minutes")
    parser.add_argument("--smoke", action="store_true", help="tiny layers, to see that the script runs")
    arguments = parser.parse_args()
    plan = smoke_plan() if arguments.smoke else whole_plan(arguments.seconds)
    out = arguments.out
    out.mkdir(parents=True, exist_ok=True)
    targets = measure_targets(arguments.data, plan)
    targets.to_csv(out / "targets.csv", index=False, float_format="%.5g")
    print(ratios(targets, plan).to_string(index=False, float_format="%.3g"), flush=True)
    if not arguments.targets_only:
        sweeps = measure_sweeps(plan)
        sweeps.to_csv(out / "sweeps.csv", index=False, float_format="%.5g")
        draw(sweeps, out / "sweeps.png")


if __name__ == "__main__":
    main()
