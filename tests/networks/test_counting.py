import math
from dataclasses import replace as with_changes

import pytest
import torch
from systems import configured, model_of, periodic_frame, periodic_scene, with_walls
from torch.utils.flop_counter import FlopCounterMode

from cconv.evaluation.cost import flops_per_particle, neighbor_density
from cconv.networks import ARCHITECTURES
from cconv.networks.counting import NeighborDensity, ball_volume
from cconv.networks.network import ConvolutionNetwork
from cconv.nn import ContinuousConv
from cconv.nn.kinds import Kinds
from cconv.ops import radial
from cconv.tasks import task_named
from cconv.tasks.features import kinds_of
from cconv.tasks.samples import make_sample

SEVERAL = {"layers": 3, "first_channels": 5, "hidden_channels": 7}
GRID = [
    configured(**SEVERAL),
    configured(**SEVERAL, interpolation="nearest_neighbor", density=False),
    configured(layers=1, kernel_size=3, walls=False, relative_cutoff=1.7),
]
RADIAL = [
    configured(architecture="radial_net", layers=1, message="difference", radial_terms=8, density=False),
    configured(architecture="radial_net", **SEVERAL, walls=False),
    configured(architecture="radial_net", layers=3, first_channels=3, hidden_channels=24, radial_terms=5),
]
GRAPHS = [
    configured(architecture="gns", layers=2, hidden_channels=6, embedding=5),
    configured(architecture="gns", layers=1, hidden_channels=7, mlp_layers=3, walls=False),
    configured(architecture="segnn", layers=2, hidden_channels=5),
    configured(architecture="segnn", layers=1, hidden_channels=4, readout_layers=2, walls=False),
]


def built(network, task, normals, generator):
    frame = with_walls(periodic_frame(generator), normals)
    scene = periodic_scene()
    sample = make_sample(frame, scene, task_named(task))
    model = model_of(network, scene, task, [sample])
    return model, sample.inputs


def counted_on(model, inputs):
    """Operations of a built model, from its weights and the pairs of its geometry."""
    geometry, network = model.geometry(inputs), model.network
    if not isinstance(network, ConvolutionNetwork):
        return of_matrix_products(network, *model.network_inputs(inputs, geometry)) / inputs.num_particles
    convs = [(conv, geometry.fluid) for conv in network.convs]
    if network.boundary_conv is not None:
        convs.append((network.boundary_conv, geometry.walls))
    total = sum(of_conv(*conv) for conv in convs) / inputs.num_particles
    for dense in network.dense:
        for name, weights in dense.named_parameters():
            repeated = model.config.dim if name == "vector_weights" else 1
            total += 0 if name == "bias" else 2 * repeated * weights.numel()
    return total


@torch.no_grad()
def of_matrix_products(network, *inputs):
    """Operations of all matrix products of a network, as torch counts them."""
    with FlopCounterMode(display=False) as counter:
        network(*inputs)
    return counter.get_total_flops()


def of_conv(conv, geometry):
    if isinstance(conv, ContinuousConv):
        return of_reads(conv.filters.flatten(0, -3), geometry.reads)
    filters, edges = (conv.scalar_filters, conv.vector_filters), geometry.edges
    of_scalars, of_vectors = (each[0] for each in filters)
    vectors, vector_outputs = conv.in_channels[1], conv.out_channels[1]
    if not radial.applies(torch.zeros(0), *(each.detach() for each in filters), edges):
        width = len(of_scalars) * (of_scalars.numel() > 0) + conv.dim * len(of_vectors) * (of_vectors.numel() > 0)
        gathered = len(edges) * (conv.dim * vectors + 2 * width)
        return 2 * (gathered + edges.num_receivers * (filters[0].numel() + conv.dim * filters[1].numel()))
    directed = of_vectors.numel() - vectors * vector_outputs
    reads = of_scalars.numel() + directed + conv.dim * vectors * vector_outputs
    return 2 * len(edges) * (3 * reads + conv.dim * (vectors + vector_outputs))


def of_reads(filters, reads):
    _, inputs, outputs = filters.shape
    products_first = 4 * reads.num_senders * outputs <= reads.num_receivers * inputs
    read = len(reads.senders) * reads.num_corners * (outputs if products_first else inputs)
    return 2 * (read + (reads.num_senders if products_first else reads.num_receivers) * filters.numel()) * (outputs > 0)


@pytest.mark.parametrize("normals", [True, False])
@pytest.mark.parametrize("task", ["density_rate", "density_gradient"])
@pytest.mark.parametrize(
    "network", GRID + RADIAL + GRAPHS, ids=lambda each: f"{each.network.architecture}-{each.network.layers}"
)
def test_equals_the_count_on_a_built_model(network, task, normals, generator):
    model, inputs = built(network, task, normals, generator)
    assert flops_per_particle(model, inputs) == pytest.approx(counted_on(model, inputs), rel=1e-6)


def test_the_count_of_every_architecture_is_checked():
    assert {each.network.architecture for each in GRID + RADIAL + GRAPHS} == set(ARCHITECTURES)


def surroundings():
    return NeighborDensity.counted(2.0, 3, neighbors=40.0, wall_neighbors=18.0, wall_points=3.0)


def cost(network=None, **changes):
    configuration = configured(**(network or {}) | changes)
    features, settings = configuration.features, configuration.network
    walls = Kinds(0, 1) if "walls" in features else None
    return settings.count(kinds_of(features), walls, Kinds(1, 0), 3, surroundings())


@pytest.mark.parametrize("architecture", ["conv_net", "radial_net"])
@pytest.mark.parametrize(
    ("name", "values"),
    [
        ("layers", (1, 2, 3, 4)),
        ("first_channels", (4, 8, 16, 32)),
        ("hidden_channels", (32, 64, 128)),
        ("relative_cutoff", (1.5, 2.0, 2.5)),
        ("walls", (False, True)),
        ("density", (False, True)),
    ],
)
def test_more_of_a_network_costs_more(name, values, architecture):
    costs = [cost(architecture=architecture, **{name: value}) for value in values]
    for quantity in ("flops_per_particle", "bytes_per_particle"):
        counts = [getattr(each, quantity) for each in costs]
        assert counts == sorted(set(counts))


def test_columns_of_wide_radial_layers_are_counted_once_a_particle():
    """Four bytes a term for 2 · 64 columns of scalars and 3 · 3 · 64 of vectors; the last layer has no vectors."""
    sizes = {"architecture": "radial_net", "layers": 4, "first_channels": 64, "hidden_channels": 64, "walls": False}
    few, many = (cost(sizes, radial_terms=terms).bytes_per_particle for terms in (8, 9))
    wide = 4 * (2 * (2 * 64 + 3 * 3 * 64) + 2 * 64)
    assert wide < many - few < 1.02 * wide


def test_maps_windows_and_norms_move_memory_and_are_no_operations_of_the_network():
    plain = cost(mapping="identity", window="none")
    for changes in ({"mapping": "ball_to_cube_radial"}, {"window": "poly6"}, {"normalize": True}):
        other = cost({"mapping": "identity", "window": "none"} | changes)
        assert other.flops_per_particle == plain.flops_per_particle
        assert other.bytes_per_particle > plain.bytes_per_particle


def test_networks_without_walls_do_not_count_them():
    inside = with_changes(surroundings(), walls=0.0, wall_points=0.0)
    network = configured().network
    costs = [network.count(Kinds(2, 1), None, Kinds(1, 0), 3, around) for around in (surroundings(), inside)]
    assert costs[0] == costs[1]


def test_points_within_reach_follow_from_those_counted_at_another_cutoff():
    """Of a lattice, with an error of the order of its points at the surface of the ball."""
    lattice = torch.cartesian_prod(*[torch.arange(-6.0, 7.0)] * 3)
    radii = lattice.norm(dim=1)
    near, far = (int((radii <= cutoff).sum()) - 1 for cutoff in (3.5, 5.5))
    around = NeighborDensity.counted(3.5, 3, near)
    assert around.fluid * ball_volume(5.5, 3) == pytest.approx(far, rel=0.1)


def test_volumes_of_balls():
    assert [ball_volume(2.0, dim) for dim in (1, 2, 3)] == pytest.approx([4.0, 4 * math.pi, 32 / 3 * math.pi])


def test_surroundings_are_counted_in_a_frame(generator):
    _, inputs = built(GRID[0], "density_rate", True, generator)
    found = neighbor_density(inputs, 1.5)
    assert found.fluid * ball_volume(1.5, 2) == pytest.approx(8, abs=1)  # of a lattice that is a little jittered
    assert found.wall_points == 8 / 64
    assert 0 < found.walls < found.fluid
