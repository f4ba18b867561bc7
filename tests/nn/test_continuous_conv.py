import itertools
from dataclasses import replace

import jaxtyping
import numpy as np
import pytest
import torch
import torch.nn.functional as F
from oracles.loop_cconv import loop_cconv

from cconv.domain import Box
from cconv.errors import ConfigError, ShapeError
from cconv.neighbors import radius_graph
from cconv.nn import AntisymmetricConv, ContinuousConv, ConvGeometry, continuous_conv
from cconv.nn.continuous_conv import INITIALIZATIONS, MESSAGES
from cconv.nn.filters import INTERPOLATIONS, MAPPINGS, WINDOWS


def normal(generator, *shape):
    return torch.randn(*shape, generator=generator, dtype=torch.float64)


def uniform(generator, *shape):
    return torch.rand(*shape, generator=generator, dtype=torch.float64)


@pytest.fixture
def cloud(generator):
    return uniform(generator, 30, 3)


@pytest.mark.parametrize(
    ("mapping", "window", "interpolation"), list(itertools.product(MAPPINGS, WINDOWS, INTERPOLATIONS))
)
def test_agrees_with_the_loop_over_pairs(mapping, window, interpolation, cloud, generator):
    features, filters = normal(generator, 30, 3), normal(generator, 3, 4, 2, 3, 5)
    for align_corners, normalize, message in itertools.product([True, False], [True, False], MESSAGES):
        settings = {
            "mapping": mapping, "window": window, "interpolation": interpolation,
            "align_corners": align_corners, "normalize": normalize,
        }  # fmt: skip
        geometry = ConvGeometry(radius_graph(cloud, 0.4), (3, 4, 2), **settings)
        expected = loop_cconv(
            cloud.numpy(), cloud.numpy(), features.numpy(), filters.numpy(), 0.4, ignore_index=True, message=message,
            **settings,
        )  # fmt: skip
        output = continuous_conv(features, filters, geometry, message=message)
        np.testing.assert_allclose(output.numpy(), expected, atol=1e-12)


@pytest.mark.parametrize("message", MESSAGES)
def test_both_orders_of_multiplication_agree(message, cloud, generator):
    """4 C_out <= C_in multiplies first; the same filters beside zeros gather first."""
    features, filters = normal(generator, 30, 8), normal(generator, 4, 4, 4, 8, 2)
    geometry = ConvGeometry(radius_graph(cloud, 0.4), 4)
    narrow = continuous_conv(features, filters, geometry, message=message)
    wide = continuous_conv(features, torch.cat([filters, torch.zeros_like(filters)], -1), geometry, message=message)
    torch.testing.assert_close(narrow, wide[:, :2])


def test_bipartite_agrees_with_the_loop(cloud, generator):
    points, normals = uniform(generator, 12, 3), normal(generator, 12, 3)
    filters = normal(generator, 4, 4, 4, 3, 3)
    edges = radius_graph(points, 0.4, queries=cloud)
    settings = {
        "mapping": "identity",
        "window": "none",
        "interpolation": "linear",
        "align_corners": True,
        "normalize": False,
    }
    expected = loop_cconv(
        cloud.numpy(), points.numpy(), normals.numpy(), filters.numpy(), 0.4, ignore_index=False, **settings
    )
    output = continuous_conv(normals, filters, ConvGeometry(edges, 4, **settings))
    np.testing.assert_allclose(output.numpy(), expected, atol=1e-12)


def test_on_a_lattice_it_is_the_dense_convolution(generator):
    """Identity map and nearest cell on an integer lattice: torch's own conv3d."""
    size, kernel = 5, 3
    axes = torch.arange(size, dtype=torch.float64)
    z, y, x = torch.meshgrid(axes, axes, axes, indexing="ij")
    positions = torch.stack([x, y, z], -1).reshape(-1, 3)
    features, filters = normal(generator, size**3, 2), normal(generator, kernel, kernel, kernel, 2, 4)
    edges = radius_graph(positions, 1.8, include_self=True)  # 1.8 > sqrt(3): the 27 cells around
    geometry = ConvGeometry(
        edges, kernel, mapping="identity", window="none", interpolation="nearest_neighbor", align_corners=False
    )
    # u = r / 3.6 and g = 3 (u + 1/2) - 1/2 = 1 + r / 1.2: whole steps land nearest to whole cells.
    grid = features.reshape(1, size, size, size, 2).permute(0, 4, 1, 2, 3)
    dense = F.conv3d(grid, filters.permute(4, 3, 0, 1, 2), padding=1)
    output = continuous_conv(features, filters, geometry)
    # Edges reach 1.8, so lattice points at distance 2 or more stay out, as in a 3³ stencil.
    torch.testing.assert_close(output, dense.permute(0, 2, 3, 4, 1).reshape(-1, 4))


def test_two_dimensions_are_three_with_a_flat_kernel(generator):
    plane, features = uniform(generator, 40, 2), normal(generator, 40, 3)
    filters = normal(generator, 4, 5, 3, 2)
    space = torch.cat([plane, torch.zeros(40, 1, dtype=torch.float64)], 1)
    flat = continuous_conv(features, filters, ConvGeometry(radius_graph(plane, 0.3), (4, 5)))
    full = continuous_conv(features, filters[None], ConvGeometry(radius_graph(space, 0.3), (1, 4, 5)))
    torch.testing.assert_close(flat, full)


def test_translation_permutation_and_periodic_wrap_change_nothing(generator):
    box = Box([0, 0], [1, 1], True)
    positions, features = uniform(generator, 60, 2), normal(generator, 60, 2)
    filters = normal(generator, 4, 4, 2, 3)

    def output(at, values):
        return continuous_conv(values, filters, ConvGeometry(radius_graph(at, 0.25, box), 4))

    expected = output(positions, features)
    torch.testing.assert_close(output(box.wrap(positions + 0.37), features), expected)
    order = torch.randperm(60, generator=generator)
    torch.testing.assert_close(output(positions[order], features[order]), expected[order])


def test_mirrored_scene_with_mirrored_filters_gives_the_same(cloud, generator):
    features, filters = normal(generator, 30, 2), normal(generator, 4, 4, 4, 2, 3)
    for axis in range(3):
        mirror = torch.ones(3, dtype=torch.float64)
        mirror[axis] = -1
        expected = continuous_conv(features, filters, ConvGeometry(radius_graph(cloud, 0.4), 4))
        flipped = filters.flip(2 - axis)  # filter axes are (z, y, x)
        mirrored = continuous_conv(features, flipped, ConvGeometry(radius_graph(cloud * mirror, 0.4), 4))
        torch.testing.assert_close(mirrored, expected)


def test_difference_messages_ignore_a_constant(cloud, generator):
    features, filters = normal(generator, 30, 2), normal(generator, 3, 3, 3, 2, 3)
    geometry = ConvGeometry(radius_graph(cloud, 0.4), 3)
    shifted = continuous_conv(features + 7.5, filters, geometry, message="difference")
    torch.testing.assert_close(shifted, continuous_conv(features, filters, geometry, message="difference"))


def test_normalised_constant_filters_average_the_neighbours(cloud, generator):
    features = normal(generator, 30, 1)
    filters = torch.ones(4, 4, 4, 1, 1, dtype=torch.float64)
    edges = radius_graph(cloud, 0.5, include_self=True)
    averages = continuous_conv(features, filters, ConvGeometry(edges, 4, window="none", normalize=True))
    within = (torch.cdist(cloud, cloud) <= 0.5).double()
    torch.testing.assert_close(averages, within @ features / within.sum(1, keepdim=True))


def test_a_receiver_without_neighbours_gives_the_bias(generator):
    positions = torch.tensor([[0.0, 0, 0], [10, 0, 0], [10.1, 0, 0]], dtype=torch.float64)
    bias = normal(generator, 4)
    for normalize in (True, False):
        geometry = ConvGeometry(radius_graph(positions, 1.0), 3, normalize=normalize)
        for channels in (2, 8):  # both orders of multiplication
            output = continuous_conv(
                normal(generator, 3, channels), normal(generator, 3, 3, 3, channels, 4), geometry, bias
            )
            assert torch.equal(output[0], bias)


@pytest.mark.parametrize("num_particles", [0, 1])
def test_no_edges_at_all(num_particles, generator):
    geometry = ConvGeometry(radius_graph(uniform(generator, num_particles, 3), 1.0), 3)
    layer = ContinuousConv(2, 4, 3, 3).double()
    output = layer(normal(generator, num_particles, 2), geometry)
    output.sum().backward()
    assert output.shape == (num_particles, 4)
    assert layer.filters.grad.abs().max() == 0


@pytest.mark.parametrize("message", MESSAGES)
@pytest.mark.parametrize(("in_channels", "out_channels"), [(2, 1), (2, 3), (4, 1), (1, 4)])
def test_gradients_of_first_and_second_order(message, in_channels, out_channels, generator):
    geometry = ConvGeometry(radius_graph(uniform(generator, 8, 2), 0.5), 3)
    inputs = (
        normal(generator, 8, in_channels).requires_grad_(),
        normal(generator, 3, 3, in_channels, out_channels).requires_grad_(),
        normal(generator, out_channels).requires_grad_(),
    )

    def convolve(features, filters, bias):
        return continuous_conv(features, filters, geometry, bias, message)

    assert torch.autograd.gradcheck(convolve, inputs)
    assert torch.autograd.gradgradcheck(convolve, inputs)


@pytest.mark.parametrize("out_channels", [1, 4])
@pytest.mark.parametrize(("mapping", "interpolation"), list(itertools.product(MAPPINGS, INTERPOLATIONS)))
def test_gradient_with_respect_to_positions(mapping, interpolation, out_channels, generator):
    positions = uniform(generator, 6, 3).requires_grad_()
    features, filters = normal(generator, 6, 4), normal(generator, 3, 4, 3, 4, out_channels)

    def convolve(at):
        edges = radius_graph(at, 0.6)
        geometry = ConvGeometry(edges, (3, 4, 3), mapping, "poly6", interpolation, align_corners=False, normalize=True)
        return continuous_conv(features, filters, geometry)

    assert torch.autograd.gradcheck(convolve, (positions,))


def test_a_particle_at_the_place_of_another_leaves_gradients_finite(generator):
    for window, mapping in itertools.product(WINDOWS, MAPPINGS):
        positions = uniform(generator, 5, 3)
        positions[1] = positions[0]
        positions.requires_grad_()
        geometry = ConvGeometry(radius_graph(positions, 2.0, include_self=True), 3, mapping, window)
        continuous_conv(normal(generator, 5, 2), normal(generator, 3, 3, 3, 2, 3), geometry).sum().backward()
        assert torch.isfinite(positions.grad).all()


@pytest.mark.parametrize("message", ["absolute", "difference"])
def test_detached_positions_are_not_differentiated(message, cloud, generator):
    geometry = ConvGeometry(radius_graph(cloud.requires_grad_(), 0.4), 3, detach_positions=True)
    features, filters = normal(generator, 30, 2), normal(generator, 3, 3, 3, 2, 4)
    assert not continuous_conv(features, filters, geometry, message=message).requires_grad


def test_stated_memory_is_what_is_held(cloud):
    reads = ConvGeometry(radius_graph(cloud, 0.4), 6).reads
    own = [reads.row_splits, reads.receivers, reads.senders, reads.cells, reads.fractions, reads.weights]
    assert sum(tensor.nbytes for tensor in [*own, *reads.by_sender]) == reads.nbytes


@pytest.mark.slow
def test_a_compiled_graph_gives_the_same(cloud, generator, monkeypatch):
    monkeypatch.setattr(jaxtyping.config, "jaxtyping_disable", True)  # the checks, not the annotations, break the graph
    features, filters = normal(generator, 30, 3), normal(generator, 4, 4, 4, 3, 5)
    geometry = ConvGeometry(radius_graph(cloud, 0.4), 4)
    compiled = torch.compile(continuous_conv, fullgraph=True, backend="aot_eager")
    torch.testing.assert_close(compiled(features, filters, geometry), continuous_conv(features, filters, geometry))


def test_float32_agrees_with_float64(cloud, generator):
    features, filters = normal(generator, 30, 3), normal(generator, 4, 4, 4, 3, 2)
    expected = continuous_conv(features, filters, ConvGeometry(radius_graph(cloud, 0.4), 4))
    output = continuous_conv(features.float(), filters.float(), ConvGeometry(radius_graph(cloud.float(), 0.4), 4))
    assert output.dtype == torch.float32
    torch.testing.assert_close(output.double(), expected, atol=1e-4, rtol=1e-4)


@pytest.mark.parametrize("initialization", INITIALIZATIONS)
def test_initial_filters_stay_within_their_bound(initialization, generator):
    layer = ContinuousConv(8, 16, 4, 3, initialization=initialization, generator=generator)
    bound = 0.05 if initialization == "open3d" else (6 / (64 * (8 + 16))) ** 0.5
    assert 0.9 * bound < layer.filters.abs().max() <= bound
    assert layer.bias.abs().max() == 0


def test_same_generator_same_filters():
    first, second = (ContinuousConv(2, 3, 3, 2, generator=torch.Generator().manual_seed(5)) for _ in range(2))
    assert torch.equal(first.filters, second.filters)


def test_the_centre_cell_is_the_particle_among_its_own_neighbours(cloud, generator):
    features = normal(generator, 30, 2)
    layer = ContinuousConv(2, 3, 3, 3, center="cell", generator=generator).double()
    neighbours, all_of_them = (ConvGeometry(radius_graph(cloud, 0.4, include_self=own), 3) for own in (False, True))
    expected = continuous_conv(features, layer.filters, all_of_them, layer.bias)
    torch.testing.assert_close(layer(features, neighbours), expected)


def test_a_dense_centre_adds_a_matrix_product(cloud, generator):
    features, geometry = normal(generator, 30, 2), ConvGeometry(radius_graph(cloud, 0.4), 4)
    layer = ContinuousConv(2, 3, 4, 3, center="dense", generator=generator).double()
    expected = continuous_conv(features, layer.filters, geometry, layer.bias) + features @ layer.center_weights
    torch.testing.assert_close(layer(features, geometry), expected)


def test_a_centre_needs_an_odd_kernel_and_neighbours_only(cloud, generator):
    with pytest.raises(ConfigError, match="'dense'"):
        ContinuousConv(2, 3, 4, 3, center="cell")
    layer = ContinuousConv(2, 3, 3, 3, center="cell").double()
    with pytest.raises(ConfigError, match="include_self"):
        layer(normal(generator, 30, 2), ConvGeometry(radius_graph(cloud, 0.4, include_self=True), 3))


@pytest.mark.parametrize("kernel_size", [4, 5])
@pytest.mark.parametrize("mapping", MAPPINGS)
def test_antisymmetric_filters_conserve_momentum(mapping, kernel_size, cloud, generator):
    layer = AntisymmetricConv(3, 3, kernel_size, 3, generator=generator).double()
    output = layer(normal(generator, 30, 3), ConvGeometry(radius_graph(cloud, 0.4), kernel_size, mapping))
    assert output.abs().max() > 1e-3
    assert output.sum(0).abs().max() < 1e-14 * 30


def test_antisymmetric_filters_refuse_normalisation(cloud, generator):
    geometry = ConvGeometry(radius_graph(cloud, 0.4), 4, normalize=True)
    with pytest.raises(ConfigError, match="normalised"):
        AntisymmetricConv(3, 3, 4, 3).double()(normal(generator, 30, 3), geometry)


@pytest.mark.parametrize("bad", [float("nan"), float("inf")])
def test_features_that_are_not_finite_are_named(bad, cloud, generator):
    features = normal(generator, 30, 2)
    features[7, 1] = bad
    with pytest.raises(ShapeError, match=f"`features` must be finite, got {bad} at \\[7, 1\\]"):
        ContinuousConv(2, 3, 4, 3).double()(features, ConvGeometry(radius_graph(cloud, 0.4), 4))


def test_edges_that_do_not_fit_are_refused(cloud):
    edges = radius_graph(cloud, 0.4)
    for damage in (
        {"num_senders": 20},
        {"row_splits": edges.row_splits + 1},
        {"row_splits": edges.row_splits.clone().index_fill_(0, torch.tensor([1]), 10**6)},
        {"receivers": edges.receivers + 30},
        {"displacements": edges.displacements * float("nan")},
    ):
        with pytest.raises(ShapeError, match="`edges`"):
            ConvGeometry(replace(edges, **damage), 4)


def test_bad_input_is_named(cloud, generator):
    edges = radius_graph(cloud, 0.4)
    geometry = ConvGeometry(edges, 4)
    features, filters = normal(generator, 30, 3), normal(generator, 4, 4, 4, 3, 2)
    with pytest.raises(ShapeError, match="`features` must have shape \\(30, 3\\)"):
        continuous_conv(features[:-1], filters, geometry)
    with pytest.raises(ShapeError, match="`filters` must have shape \\(4, 4, 4"):
        continuous_conv(features, filters[:3], geometry)
    with pytest.raises(ShapeError, match="`bias`"):
        continuous_conv(features, filters, geometry, torch.zeros(3, dtype=torch.float64))
    with pytest.raises(ShapeError, match="dtype"):
        continuous_conv(features.float(), filters, geometry)
    with pytest.raises(ShapeError, match="`bias` must share dtype and device"):
        continuous_conv(features, filters, geometry, torch.zeros(2))
    with pytest.raises(ShapeError, match="`filters` must share dtype and device"):
        continuous_conv(features, filters.to("meta"), geometry)
    for misnamed in ({"mapping": "identiy"}, {"window": "poly7"}, {"interpolation": "cubic"}):
        with pytest.raises(ConfigError, match=next(iter(misnamed))):
            ConvGeometry(edges, 4, **misnamed)
    for kernel_size in (0, 2.5, (4, 4), (4, 4, 0)):
        with pytest.raises(ConfigError, match="kernel_size"):
            ConvGeometry(edges, kernel_size)
    with pytest.raises(ConfigError, match="difference"):
        continuous_conv(features, filters, geometry, message="differences")
    bipartite = ConvGeometry(radius_graph(cloud, 0.4, queries=cloud), 4)
    with pytest.raises(ConfigError, match="'absolute'"):
        continuous_conv(features, filters, bipartite, message="difference")
