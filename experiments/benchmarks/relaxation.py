"""Time of the SPH relaxation of one frame: 2,500 particles in 2D and 8,000 in 3D, with 1, 3 and 5 loops.

    python experiments/benchmarks/relaxation.py [--threads 2] [--repeats 50] [--smoke]

Prints the median and the quartiles of each in ms, the search for neighbours included. The cases take turns, so that a
change of the machine's speed meets all of them alike. Particles lie shaken on a periodic lattice.
"""

import argparse
import time

import numpy as np
import torch

from cconv import Box
from cconv.scenes.walls import lattice
from cconv.sph import relax

SPACING = 0.02
CASES = [(dim, cells, loops) for dim, cells in ((2, 50), (3, 20)) for loops in (1, 3, 5)]


def shaken(dim: int, cells: int, generator: torch.Generator) -> torch.Tensor:
    """Particles (N, D) up to 0.3 spacings off a lattice, in single precision as rollouts of stored data begin."""
    at_rest = lattice([cells] * dim, SPACING, [0.0] * dim)
    return (at_rest + 0.3 * SPACING * (2 * torch.rand(at_rest.shape, generator=generator) - 1)).float()


def milliseconds(dim: int, cells: int, loops: int, generator: torch.Generator) -> float:
    """Time of one relaxation of new positions."""
    positions = shaken(dim, cells, generator)
    box = Box([0.0] * dim, [cells * SPACING] * dim, True)
    walls = torch.zeros(len(positions), dtype=torch.bool)
    start = time.perf_counter()
    relax(positions, positions, walls, box=box, particle_spacing=SPACING, alpha=0.02, beta=0.3, loops=loops)
    return 1000 * (time.perf_counter() - start)


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--repeats", type=int, default=50)
    parser.add_argument("--smoke", action="store_true", help="once, to see that it runs")
    arguments = parser.parse_args()
    torch.set_num_threads(arguments.threads)
    generator = torch.Generator().manual_seed(0)
    repeats = 1 if arguments.smoke else arguments.repeats
    turns = [[milliseconds(*case, generator) for case in CASES] for _ in range(repeats + 1)]
    taken = np.array(turns[1:])  # the first turn compiles
    for (dim, cells, loops), low, median, high in zip(
        CASES, *np.quantile(taken, [0.25, 0.5, 0.75], axis=0), strict=True
    ):
        print(f"{cells**dim} particles in {dim}D, {loops} loops: {median:.1f} ms ({low:.1f} to {high:.1f})")


if __name__ == "__main__":
    main()
