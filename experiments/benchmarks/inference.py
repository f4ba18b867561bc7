"""Time of predicting a frame: the published network beside single radial layers, growth with particles, the cost model.

    python experiments/benchmarks/inference.py --data FOLDER [--out FOLDER] [--before FOLDER]

One thread. Models take turns, so that a change of the machine's speed meets all of them alike; medians and quartiles.
`--before` names a checkout of an earlier state: it and this one take turns too, each in a process of its own, and a
ratio compares two frames of one turn. Writes `inference.json` and `inference.png`. Weights are drawn at random: they do
not change the time. The data are the dam break of DPI-Net.
"""

import argparse
import json
import math
import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from itertools import islice
from pathlib import Path

import matplotlib.pyplot as plt
import torch
from matplotlib.ticker import LogLocator, NullFormatter, ScalarFormatter

from cconv import open_dataset, radius_graph
from cconv.data.trajectory import Frame, Scene
from cconv.domain import Box
from cconv.evaluation.cost import neighbor_density
from cconv.models.checkpoint import load_model, save_model
from cconv.models.model import Model, build_model
from cconv.nn.kinds import Kinds
from cconv.study.declared.configuration import DEFAULTS, configure
from cconv.tasks import task_named
from cconv.tasks.features import WALLS, kinds_of
from cconv.tasks.samples import Sample, make_sample

SPACING = 0.05
DIM = 3
LAYERS = {"network.architecture": "radial_net"}
LAYER = LAYERS | {
    "network.layers": 1,
    "network.message": "difference",
    "network.relative_cutoff": 2.0,
    "network.window": "none",
}
COMPARED = {
    "published network": {},
    "radial layer": LAYER,
    "radial layer, no walls": LAYER | {"task.features.walls": False, "task.features.density": False},
}
CHECKED = COMPARED | {
    "grid layer": {"network.layers": 1},
    "grid layer, identity": {"network.layers": 1, "network.mapping": "identity", "network.window": "none"},
    "grid layer, K = 6, no walls": {"network.layers": 1, "network.kernel_size": 6, "task.features.walls": False},
    "2 grid layers of 8": {"network.layers": 2, "network.first_channels": 8},
    "2 grid layers, nearest cell": {
        "network.layers": 2,
        "network.first_channels": 16,
        "network.interpolation": "nearest_neighbor",
    },
    "3 grid layers of 16": {"network.layers": 3, "network.first_channels": 16, "network.hidden_channels": 16},
    "3 grid layers, R = 1.5, no walls": {
        "network.layers": 3,
        "network.mapping": "identity",
        "network.relative_cutoff": 1.5,
        "task.features.walls": False,
    },
    "4 grid layers, K = 3": {"network.kernel_size": 3, "network.first_channels": 16, "network.hidden_channels": 32},
    "radial layer, poly6, R = 2.5": LAYER
    | {"network.window": "poly6", "network.relative_cutoff": 2.5, "task.features.walls": False},
    "2 radial layers of 8": LAYERS | {"network.layers": 2, "network.first_channels": 8},
    "2 radial layers of 32, no walls": {
        "network.layers": 2,
        "network.architecture": "radial_net",
        "network.first_channels": 32,
        "task.features.walls": False,
    },
    "3 radial layers of 8": LAYERS | {"network.layers": 3, "network.first_channels": 8, "network.hidden_channels": 8},
    "2 radial layers of 64": LAYERS | {"network.layers": 2, "network.first_channels": 64},
    "3 radial layers of 32": LAYERS
    | {"network.layers": 3, "network.first_channels": 32, "network.hidden_channels": 32},
    "3 radial layers of 64": LAYERS
    | {"network.layers": 3, "network.first_channels": 64, "network.hidden_channels": 64},
    "3 radial layers of 64, 8 terms, no walls": LAYERS
    | {
        "network.layers": 3,
        "network.first_channels": 64,
        "network.hidden_channels": 64,
        "network.radial_terms": 8,
        "task.features.walls": False,
    },
    "4 radial layers of 32, 8 terms": LAYERS
    | {"network.first_channels": 32, "network.hidden_channels": 32, "network.radial_terms": 8},
}
SEARCHES = [(dim, count, periodic) for dim in (1, 2, 3) for count in (500, 5000, 50_000) for periodic in (False, True)]
SEARCHES += [(3, 100_000, False), (3, 100_000, True)]


@dataclass(frozen=True, kw_only=True)
class Plan:
    """What is measured.

    Attributes:
        checked: Networks, by name, whose times the cost model predicts.
        searches: Dimension, number of particles and periodicity of each neighbour search.
        sizes: Numbers of particles over which times grow.
        rounds: Timed calls of each.
    """

    checked: Mapping[str, Mapping]
    searches: Sequence[tuple[int, int, bool]]
    sizes: Sequence[int]
    rounds: int


def whole_plan(rounds: int) -> Plan:
    return Plan(checked=CHECKED, searches=SEARCHES, sizes=(1000, 3000, 10_000, 30_000, 100_000), rounds=rounds)


def smoke_plan() -> Plan:
    """Sizes too small for the figures to mean anything, to see that the script runs."""
    searches = [(dim, 100, periodic) for dim in (1, 2, 3) for periodic in (False, True)]
    return Plan(checked=dict(islice(CHECKED.items(), 6)), searches=searches, sizes=(50, 100), rounds=2)


def frame_of(folder: Path) -> tuple[Scene, Frame]:
    dataset = open_dataset(folder, mass=0.125, particle_spacing=SPACING, frame_dt=1 / 60)
    return dataset.scene, dataset.trajectory("train", 0)[20]


def sample_of(scene: Scene, frame: Frame) -> Sample:
    return make_sample(frame, scene, task_named("density_rate"))


def model_of(settings: Mapping, scene: Scene, sample: Sample) -> Model:
    chosen = configure(settings, DEFAULTS)
    return build_model(chosen.network, task_named("density_rate"), chosen.features, scene, [sample]).eval()


def cloud(dim: int, count: int, periodic: bool) -> tuple[torch.Tensor, Box]:
    """A jittered lattice of unit spacing in no particular order, in its box."""
    generator, side = torch.Generator().manual_seed(0), math.ceil(count ** (1 / dim))
    lattice = torch.cartesian_prod(*[torch.arange(side) + 0.5] * dim).reshape(-1, dim)
    chosen = lattice[torch.randperm(len(lattice), generator=generator)[:count]]
    return chosen + 0.3 * (torch.rand(chosen.shape, generator=generator) - 0.5), Box([0] * dim, [side] * dim, periodic)


class Calls:
    """What a state of the code is timed on, by name; each call returns its parts' times in ms."""

    def __init__(self, folder: Path, searches: list[tuple[int, int, bool]]):
        scene, frame = frame_of(folder)
        sample = sample_of(scene, frame)
        self.calls = {}
        for name, settings in COMPARED.items():
            model = model_of(settings, scene, sample)
            self.calls[name] = lambda model=model: self.predict(model, sample.inputs)
        for search in searches:
            positions, box = cloud(*search)
            self.calls[json.dumps(search)] = lambda positions=positions, box=box: self.search(positions, box)

    @torch.no_grad()
    def predict(self, model: Model, inputs) -> tuple[float, float]:
        start = time.perf_counter()
        geometry = model.geometry(inputs)
        middle = time.perf_counter()
        model(inputs, geometry)
        return 1e3 * (middle - start), 1e3 * (time.perf_counter() - middle)

    def search(self, positions: torch.Tensor, box: Box) -> tuple[float, float]:
        start = time.perf_counter()
        radius_graph(positions, 2.0, box)
        return 1e3 * (time.perf_counter() - start), 0.0


def serve(folder: Path, searches: list) -> None:
    """Time what is named on each line of standard input."""
    torch.set_num_threads(1)
    calls = Calls(folder, searches).calls
    for line in sys.stdin:
        print(json.dumps(calls[json.loads(line)]()), flush=True)


class State:
    """A process of its own for a checkout of the code."""

    def __init__(self, checkout: Path, data: Path, searches: list):
        command = [sys.executable, __file__, "--data", str(data.resolve()), "--serve", json.dumps(searches)]
        environment = os.environ | {"PYTHONPATH": str(checkout.resolve())}
        self.process = subprocess.Popen(
            command, env=environment, cwd=checkout, text=True, stdin=subprocess.PIPE, stdout=subprocess.PIPE
        )

    def time(self, name: str) -> list[float]:
        print(json.dumps(name), file=self.process.stdin, flush=True)
        return json.loads(self.process.stdout.readline())

    def close(self) -> None:
        self.process.stdin.close()
        self.process.wait()


def quartiles(values: list[float]) -> dict[str, float]:
    low, median, high = statistics.quantiles(values, n=4, method="inclusive")
    return {"median": median, "low": low, "high": high}


def compare(checkouts: Mapping[str, Path], data: Path, plan: Plan) -> dict:
    """Times of each call in each state, and ratios within a round; the first round is a warm-up."""
    states = {name: State(checkout, data, plan.searches) for name, checkout in checkouts.items()}
    names = [*COMPARED, *map(json.dumps, plan.searches)]
    times = {name: {state: [] for state in states} for name in names}
    for turn in range(plan.rounds + 1):
        for name in names:
            for state, process in states.items():
                parts = process.time(name)
                if turn > 0:
                    times[name][state].append(parts)
    for process in states.values():
        process.close()
    total = {name: {state: [sum(t) for t in times[name][state]] for state in states} for name in names}
    rows = {}
    for name in names:
        rows[name] = {
            state: {"ms": quartiles(total[name][state])}
            | {
                part: statistics.median(p)
                for part, p in zip(("geometry_ms", "network_ms"), zip(*parts, strict=True), strict=True)
            }
            for state, parts in times[name].items()
        }
        if "before" in states:
            rows[name]["before / now"] = ratio(total[name]["before"], total[name]["now"])
        if name in COMPARED:
            rows[name]["published now / this now"] = ratio(total["published network"]["now"], total[name]["now"])
    return rows


def ratio(numerators: list[float], denominators: list[float]) -> dict[str, float]:
    return quartiles([a / b for a, b in zip(numerators, denominators, strict=True)])


def measure_checks(data: Path, plan: Plan) -> dict:
    """Growth of the compared models, and the cost model's predictions for many."""

    from cconv.evaluation.cost import measure_costs, measure_growth
    from cconv.evaluation.time_model import check_cost_model

    scene, frame = frame_of(data)
    sample = sample_of(scene, frame)
    around = neighbor_density(sample.inputs, 2.0)
    with tempfile.TemporaryDirectory() as folder:
        saved = {name: Path(folder) / str(place) for place, name in enumerate(plan.checked)}
        for name, path in saved.items():
            save_model(model_of(plan.checked[name], scene, sample), path, {})
        compared = {name: saved[name] for name in COMPARED}
        field = load_model(saved["published network"]).config
        growth = measure_growth(
            compared, load_model, analytic=field, sizes=plan.sizes, threads=1, repeats=max(2, plan.rounds // 4)
        )
        costs, analytic = measure_costs(
            saved,
            load_model,
            [frame],
            scene,
            task=task_named("density_rate"),
            threads=1,
            repeats=max(2, plan.rounds // 2),
        )
    counted = {}
    for name, settings in plan.checked.items():
        chosen = configure(settings, DEFAULTS)
        walls = Kinds(0, 1) if WALLS in chosen.features else None
        counted[name] = chosen.network.count(kinds_of(chosen.features), walls, Kinds(1, 0), DIM, around)
    check = check_cost_model(counted, {name: cost.us_per_particle for name, cost in costs.items()})
    return {
        "growth": {name: asdict(each) for name, each in growth.items()},
        "costs": {name: asdict(cost) for name, cost in costs.items()},
        "analytic": asdict(analytic),
        "estimates": {name: asdict(each) for name, each in counted.items()},
        "cost_model": asdict(check),
    }


def draw(results: dict, path: Path) -> None:
    figure, panels = plt.subplots(2, 2, figsize=(11, 8), layout="constrained")
    draw_models(panels[0, 0], results["compared"])
    draw_searches(panels[0, 1], results["compared"])
    draw_growth(panels[1, 0], results["growth"])
    draw_check(panels[1, 1], results["cost_model"])
    figure.suptitle(f"One thread, float32; frame of {results['num_particles']:,} fluid particles, {results['machine']}")
    figure.savefig(path, dpi=120)
    plt.close(figure)


def draw_models(panel: plt.Axes, compared: dict) -> None:
    states = [state for state in ("before", "now") if state in compared["published network"]]
    for place, name in enumerate(COMPARED):
        for step, state in enumerate(states):
            row, at = compared[name][state], place + 0.4 * step
            panel.barh(at, row["geometry_ms"], 0.36, color="C0", alpha=0.5 + 0.5 * (state == "now"))
            panel.barh(at, row["network_ms"], 0.36, row["geometry_ms"], color="C1", alpha=0.5 + 0.5 * (state == "now"))
            panel.text(
                sum((row["geometry_ms"], row["network_ms"])), at, f" {state} {row['ms']['median']:.3g} ms", va="center"
            )
    panel.set_yticks([place + 0.2 for place in range(len(COMPARED))], list(COMPARED))
    panel.invert_yaxis()
    panel.margins(x=0.4)
    panel.set(xlabel="ms per frame", title="search and geometry (blue), network (orange)")


def draw_searches(panel: plt.Axes, compared: dict) -> None:
    searches = {tuple(json.loads(name)): row for name, row in compared.items() if name not in COMPARED}
    for dim in (1, 2, 3):
        for periodic in (False, True):
            rows = {count: row for (d, count, p), row in searches.items() if (d, p) == (dim, periodic)}
            values = [row.get("before / now", row["now"]["ms"]) for row in rows.values()]
            medians = [value["median"] for value in values]
            errors = [
                [value["median"] - value["low"] for value in values],
                [value["high"] - value["median"] for value in values],
            ]
            label = f"{dim}D, {'periodic' if periodic else 'open'}"
            panel.errorbar(
                list(rows),
                medians,
                errors,
                marker="o",
                capsize=2,
                color=f"C{dim}",
                label=label,
                ls="--" if periodic else "-",
            )
    has_ratio = all("before / now" in row for row in searches.values())
    panel.axhline(1, color="black", lw=0.8)
    panel.set(xscale="log", yscale="log", xlabel="particles", title="neighbour search, cutoff of two spacings")
    panel.set_ylabel("time before / now" if has_ratio else "ms")
    panel.legend(fontsize=8)


def draw_growth(panel: plt.Axes, growth: dict) -> None:
    for name, each in growth.items():
        times = each["times"]
        panel.plot(
            [time["num_particles"] for time in times],
            [time["ms_per_frame"] for time in times],
            marker="o",
            label=f"{name}: N^{each['exponent']:.2f}",
        )
    panel.set(xscale="log", yscale="log", xlabel="particles", ylabel="ms per frame", title="growth on blocks of fluid")
    panel.legend(fontsize=8)


def draw_check(panel: plt.Axes, check: dict) -> None:
    measured, predicted = list(check["measured"].values()), list(check["predicted"].values())
    panel.scatter(measured, predicted, s=18)
    ends = [0.7 * min(measured + predicted), 1.4 * max(measured + predicted)]
    panel.plot(ends, ends, color="black", lw=0.8)
    title = f"cost model: median error {check['median_relative_error']:.0%}, rank {check['rank_correlation']:.2f}"
    panel.set(
        xscale="log", yscale="log", xlabel="measured, µs a particle", ylabel="predicted from the others", title=title
    )
    for axis in (panel.xaxis, panel.yaxis):
        axis.set_major_locator(LogLocator(subs=(1, 2, 5)))
        axis.set_major_formatter(ScalarFormatter())
        axis.set_minor_formatter(NullFormatter())


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, required=True, help="DeepLagrangianFluids folder of the DPI dam break")
    parser.add_argument("--out", type=Path, default=Path(__file__).parent / "results" / "inference")
    parser.add_argument("--before", type=Path, help="checkout of an earlier state to compare with")
    parser.add_argument("--rounds", type=int, default=20, help="timed calls of each")
    parser.add_argument("--smoke", action="store_true", help="small sizes, to see that the script runs")
    parser.add_argument("--serve", type=json.loads, help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.serve is not None:
        serve(arguments.data, [tuple(search) for search in arguments.serve])
        return
    plan = smoke_plan() if arguments.smoke else whole_plan(arguments.rounds)
    checkouts = {"before": arguments.before} if arguments.before else {}
    checkouts["now"] = Path(__file__).parents[2]
    results = {
        "machine": f"{os.cpu_count()} cores, torch {torch.__version__}",
        "num_particles": len(frame_of(arguments.data)[1].positions),
        "threads": 1,
        "compared": compare(checkouts, arguments.data, plan),
        **measure_checks(arguments.data, plan),
    }
    arguments.out.mkdir(parents=True, exist_ok=True)
    (arguments.out / "inference.json").write_text(json.dumps(results, indent=1) + "\n")
    draw(results, arguments.out / "inference.png")
    for name in COMPARED:
        print(name, json.dumps(results["compared"][name]))


if __name__ == "__main__":
    main()
