import itertools

import numpy as np
import pytest
import torch
import torch.nn.functional as F
from oracles.loop_cconv import loop_cconv

from cconv.domain import Box
from cconv.errors import ConfigError, ShapeError
from cconv.neighbors import radius_graph
from cconv.nn import ContinuousConv, ConvGeometry, continuous_conv
from cconv.nn.continuous_conv import INITIALIZATIONS
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
    for align_corners, normalize, message in itertools.product(
        [True, False], [True, False], ["absolute", "difference"]
    ):
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


@pytest.mark.parametrize("message", ["absolute", "difference"])
def test_both_orders_of_multiplication_agree(message, cloud, generator):
    """C_out < C_in multiplies first; the same filters beside zeros, so that C_out >= C_in, gather first."""
    features, filters = normal(generator, 30, 4), normal(generator, 4, 4, 4, 4, 2)
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


@pytest.mark.parametrize("message", ["absolute", "difference"])
@pytest.mark.parametrize("out_channels", [1, 3])
def test_gradients_of_first_and_second_order(message, out_channels, generator):
    geometry = ConvGeometry(radius_graph(uniform(generator, 8, 2), 0.5), 3)
    inputs = (
        normal(generator, 8, 2).requires_grad_(),
        normal(generator, 3, 3, 2, out_channels).requires_grad_(),
        normal(generator, out_channels).requires_grad_(),
    )

    def convolve(features, filters, bias):
        return continuous_conv(features, filters, geometry, bias, message)

    assert torch.autograd.gradcheck(convolve, inputs)
    assert torch.autograd.gradgradcheck(convolve, inputs)


@pytest.mark.parametrize("message", ["absolute", "difference"])
def test_nothing_is_differentiated_with_respect_to_positions(message, cloud, generator):
    geometry = ConvGeometry(radius_graph(cloud.requires_grad_(), 0.4), 3)
    features, filters = normal(generator, 30, 2), normal(generator, 3, 3, 3, 2, 4)
    assert not continuous_conv(features, filters, geometry, message=message).requires_grad


def test_stated_memory_covers_every_matrix(cloud):
    geometry = ConvGeometry(radius_graph(cloud, 0.4), 6)
    matrices = [geometry.gather, geometry.gather.transposed, geometry.read, geometry.read.transposed]
    tensors = [tensor for matrix in matrices for tensor in (matrix.offsets, matrix.columns, matrix.values)]
    own = [geometry.cell_sums, geometry.cells, geometry.weights, geometry.receivers, geometry.senders]
    needed = sum(tensor.nbytes for tensor in [*tensors, *own])
    assert 0.7 * geometry.nbytes < needed <= geometry.nbytes + 64


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
    with pytest.raises(ConfigError, match="kernel_size"):
        ConvGeometry(edges, 0)
    with pytest.raises(ConfigError, match="kernel_size"):
        ConvGeometry(edges, (4, 4))
    with pytest.raises(ConfigError, match="difference"):
        continuous_conv(features, filters, geometry, message="differences")
    bipartite = ConvGeometry(radius_graph(cloud, 0.4, queries=cloud), 4)
    with pytest.raises(ConfigError, match="'absolute'"):
        continuous_conv(features, filters, bipartite, message="difference")
