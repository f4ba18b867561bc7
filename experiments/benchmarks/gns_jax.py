"""The published GNS in JAX, timed frame by frame for gns.py, which starts this in an environment of its own.

Needs jax, dm-haiku and jraph; reads the graph from an .npz file, and for each line on stdin prints the time of a frame
in ms. Layers and their order are those of LagrangeBench's `models/gns.py`.
"""

import sys
import time

import haiku as hk
import jax
import jax.numpy as jnp
import jraph
import numpy as np


def perceptron(width, outputs, norm=True):
    """Linear, ReLU, linear, and a layer normalisation."""
    layers = [hk.Linear(width), jax.nn.relu, hk.Linear(outputs)]
    return hk.Sequential([*layers, hk.LayerNorm(-1, True, True)] if norm else layers)


def network(graph, layers, width, outputs):
    """Encoder, message passing, decoder."""
    graph = jraph.GraphMapFeatures(perceptron(width, width), perceptron(width, width))(graph)
    for _ in range(layers):
        step = jraph.GraphNetwork(
            update_edge_fn=lambda edges, sent, received, _: perceptron(width, width)(
                jnp.concatenate([sent, received, edges], axis=-1)
            ),
            update_node_fn=lambda nodes, _, received, __: perceptron(width, width)(
                jnp.concatenate([nodes, received], axis=-1)
            ),
        )
        after = step(graph)
        graph = graph._replace(nodes=graph.nodes + after.nodes, edges=graph.edges + after.edges)
    return perceptron(width, outputs, norm=False)(graph.nodes)


def main():
    """Print a line that says that all is compiled, then a time for each line that comes."""
    path, layers, width = sys.argv[1], int(sys.argv[2]), int(sys.argv[3])
    given = {name: jnp.asarray(values) for name, values in np.load(path).items()}
    counts = {"n_node": jnp.array([len(given["nodes"])]), "n_edge": jnp.array([len(given["edges"])])}
    graph = jraph.GraphsTuple(**given, globals=None, **counts)
    model = hk.without_apply_rng(hk.transform(lambda graph: network(graph, layers, width, given["edges"].shape[1] - 1)))
    weights = model.init(jax.random.PRNGKey(0), graph)
    answer = jax.jit(model.apply)
    answer(weights, graph).block_until_ready()
    print(sum(values.size for values in jax.tree_util.tree_leaves(weights)), flush=True)
    for _ in sys.stdin:
        start = time.perf_counter()
        answer(weights, graph).block_until_ready()
        print(1e3 * (time.perf_counter() - start), flush=True)


if __name__ == "__main__":
    main()
