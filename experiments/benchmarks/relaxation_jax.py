"""Time of the SPH relaxation of Neural SPH in JAX, to stand beside `relaxation.py`: 2,500 particles in 2D.

    python -m venv jax
    jax/bin/pip install --no-deps --ignore-requires-python jax-sph
    jax/bin/pip install "jax[cpu]==0.4.29" "numpy<2" "scipy<1.13" jraph absl-py omegaconf h5py pyvista
    jax/bin/python experiments/benchmarks/relaxation_jax.py [--repeats 50]

It needs that environment of its own, and does not import this project. The algorithm is that of Toshev et al., "Neural
SPH" (2024), section 3.2, without walls: jax-sph's neighbour list and quintic kernel, segment sums over its pairs,
compiled as one function for all loops. Prints the median and the quartiles in ms.
"""

import argparse
import time

import jax
import jax.numpy as jnp
import numpy as np
from jax import jit, vmap
from jax.ops import segment_sum
from jax_sph.jax_md import space
from jax_sph.kernel import QuinticKernel
from jax_sph.partition import neighbor_list

CELLS, LOOPS = 50, (1, 3, 5)
ALPHA, BETA, LOWEST, HIGHEST, STIFFNESS = 0.02, 0.3, 0.98, 1.02, 100.0


def relaxation(loops, displacement, shift):
    """A compiled function of positions (N, 2), those before, and neighbours: relaxed positions, neighbours."""
    kernel = QuinticKernel(h=1.0, dim=2)
    values, slopes = vmap(kernel.w), vmap(kernel.grad_w)

    def loop(positions, before, neighbors):
        neighbors = neighbors.update(positions)
        i, j = neighbors.idx
        apart = vmap(displacement)(positions[i % len(positions)], positions[j % len(positions)])
        is_pair = i < len(positions)
        distances = jnp.where(is_pair, jnp.sqrt((apart**2).sum(axis=1) + 1e-16), 4.0)
        density = segment_sum(values(distances), i, len(positions))
        density = jnp.minimum(jnp.where(density < LOWEST, 1.0, density), HIGHEST)
        pressure = STIFFNESS * (density - 1)
        velocity = vmap(displacement)(positions, before)
        of_i, of_j = density[i % len(positions)], density[j % len(positions)]
        between = (of_j * pressure[i % len(positions)] + of_i * pressure[j % len(positions)]) / (of_i + of_j)
        direction = apart / distances[:, None]
        change = (velocity[i % len(positions)] - velocity[j % len(positions)]) / distances[:, None]
        terms = -between[:, None] * direction + BETA * change
        terms = (1 / of_i**2 + 1 / of_j**2)[:, None] * slopes(distances)[:, None] * terms
        acceleration = segment_sum(jnp.where(is_pair[:, None], terms, 0.0), i, len(positions))
        return shift(positions, ALPHA * acceleration), neighbors

    @jit
    def relax(positions, before, neighbors):
        for _ in range(loops):
            positions, neighbors = loop(positions, before, neighbors)
        return positions, neighbors

    return relax


def shaken(generator):
    """Particles (N, 2) up to 0.3 spacings off a lattice of spacing 1."""
    axis = np.arange(CELLS) + 0.5
    lattice = np.stack(np.meshgrid(axis, axis, indexing="ij"), axis=-1).reshape(-1, 2)
    return jnp.asarray(lattice + 0.3 * generator.uniform(-1, 1, lattice.shape), jnp.float32)


def main():
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--repeats", type=int, default=50)
    repeats = parser.parse_args().repeats
    generator = np.random.default_rng(0)
    box = jnp.full(2, float(CELLS))
    displacement, shift = space.periodic(side=box)
    neighbors_of = neighbor_list(displacement, box, 3.0, dr_threshold=0.0, capacity_multiplier=1.25, mask_self=False)
    first = shaken(generator)
    neighbors = neighbors_of.allocate(first)
    taken = {}
    for loops in LOOPS:
        relax = relaxation(loops, displacement, shift)
        jax.block_until_ready(relax(first, first, neighbors))  # compiles
        taken[loops] = []
        for _ in range(repeats):
            positions = jax.block_until_ready(shaken(generator))
            start = time.perf_counter()
            _, found = jax.block_until_ready(relax(positions, positions, neighbors))
            taken[loops].append(1000 * (time.perf_counter() - start))
            assert not bool(found.did_buffer_overflow)
    for loops, times in taken.items():
        low, median, high = np.quantile(times, [0.25, 0.5, 0.75])
        print(f"{CELLS**2} particles in 2D, {loops} loops: {median:.1f} ms ({low:.1f} to {high:.1f})")


if __name__ == "__main__":
    main()
