"""Time of a frame of the published GNS on 2,500 particles in two dimensions, here and in JAX, in turns.

    python experiments/benchmarks/gns.py --jax PYTHON [--out FILE]

PYTHON is the interpreter of another environment with jax, dm-haiku and jraph. Both are given the same graph, so that
neighbour search and features count for neither; the time of our whole network, with its geometry, stands beside. They
take turns, so that a change of the machine's speed meets both alike: the ratio is the median of the ratios of all
turns. Weights are drawn at random: they do not change the time.
"""

import argparse
import json
import os
import statistics
import subprocess
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch

from cconv import Box, radius_graph
from cconv.networks import GNSSettings
from cconv.nn.kinds import Kinds

INPUTS = Kinds(10, 5)  # one, nine types, five velocities
REFERENCE = Path(__file__).with_name("gns_jax.py")


def parsed() -> argparse.Namespace:
    """Arguments of the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--jax", metavar="PYTHON", help="interpreter with jax, dm-haiku and jraph")
    parser.add_argument("--out", type=Path, help="JSON file to write")
    parser.add_argument("--turns", type=int, default=15)
    parser.add_argument("--threads", type=int, default=os.cpu_count() or 1, help="of both; by default one a core")
    parser.add_argument("--smoke", action="store_true", help="tiny sizes, to see whether it runs")
    return parser.parse_args()


class Ours:
    """Our network on a graph."""

    def __init__(self, settings: GNSSettings, side: int):
        generator = torch.Generator().manual_seed(0)
        ticks = torch.arange(side) + 0.5
        positions = torch.cartesian_prod(ticks, ticks)
        self.positions = positions + 0.3 * (torch.rand(positions.shape, generator=generator) - 0.5)
        self.settings, self.box = settings, Box([0, 0], [side, side], True)
        self.network = settings.build(INPUTS, None, Kinds(0, 1), 2, generator)
        self.features = torch.randn(side**2, INPUTS.num_values(2) - 1, generator=generator)
        self.geometry = self.search()

    def search(self):
        """Geometry of the particles."""
        edges = radius_graph(self.positions, self.settings.relative_cutoff, self.box, include_self=True)
        return self.settings.geometry(edges)

    @torch.no_grad()
    def times(self) -> tuple[float, float]:
        """Time of the network and of the geometry, ms."""
        start = time.perf_counter()
        self.search()
        middle = time.perf_counter()
        self.network(self.features, self.geometry)
        return 1e3 * (time.perf_counter() - middle), 1e3 * (middle - start)

    def save(self, path: Path) -> None:
        """Write the graph as the reference reads it, its nodes as wide as the particles that are encoded."""
        known = self.network.particle_encoder.parts[0]
        edges = self.geometry.edges
        np.savez(
            path,
            nodes=np.random.default_rng(0).normal(size=(len(self.positions), known)).astype(np.float32),
            edges=self.geometry.features.numpy(),
            senders=edges.senders.numpy().astype(np.int32),
            receivers=edges.receivers.numpy().astype(np.int32),
        )


class Reference:
    """The network in JAX, in a process of its own."""

    def __init__(self, python: str, graph: Path, settings: GNSSettings):
        command = [python, str(REFERENCE), str(graph), str(settings.layers), str(settings.hidden_channels)]
        if torch.get_num_threads() == 1:
            command = ["taskset", "--cpu-list", f"{os.cpu_count() - 1}", *command]  # JAX takes as many as it sees
        pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE}
        self.process = subprocess.Popen(command, text=True, **pipes)
        self.parameters = int(self._line())

    def time(self) -> float:
        """Time of a frame, ms."""
        assert self.process.stdin is not None
        self.process.stdin.write("\n")
        self.process.stdin.flush()
        return float(self._line())

    def close(self) -> None:
        """End the process."""
        assert self.process.stdin is not None
        self.process.stdin.close()
        self.process.wait()

    def _line(self) -> str:
        assert self.process.stdout is not None
        line = self.process.stdout.readline()
        if not line:
            raise SystemExit("the reference ended; look at what it printed.")
        return line


def summarised(times: Sequence[float]) -> dict[str, float]:
    """Median and quartiles, ms."""
    low, median, high = statistics.quantiles(times, n=4, method="inclusive")
    return {"median": median, "low": low, "high": high}


def main() -> None:
    """Measure, print, write."""
    arguments = parsed()
    settings = GNSSettings(layers=2, hidden_channels=8) if arguments.smoke else GNSSettings()
    torch.set_num_threads(arguments.threads)
    ours = Ours(settings, 8 if arguments.smoke else 50)
    ours.times()
    found: dict[str, object] = {"particles": len(ours.positions), "pairs": len(ours.geometry.edges)}
    found["threads"] = torch.get_num_threads()
    with tempfile.TemporaryDirectory() as folder:
        reference = None
        if arguments.jax:
            graph = Path(folder) / "graph.npz"
            ours.save(graph)
            reference = Reference(arguments.jax, graph, settings)
            reference.time()
        turns = [(*ours.times(), reference.time() if reference else 0.0) for _ in range(arguments.turns)]
        network, geometry, theirs = zip(*turns, strict=True)
        found |= {"network_ms": summarised(network), "geometry_ms": summarised(geometry)}
        if reference:
            ratios = [other / mine for mine, _, other in turns]
            found |= {"jax_ms": summarised(theirs), "jax_over_ours": summarised(ratios)}
            found["jax_parameters"] = reference.parameters
            reference.close()
    print(json.dumps(found, indent=2))
    if arguments.out:
        arguments.out.write_text(json.dumps(found, indent=2))


if __name__ == "__main__":
    main()
