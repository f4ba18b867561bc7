"""The differentiable path of compiled loops against the general one."""

import itertools

import pytest
import torch

from cconv.neighbors import radius_graph
from cconv.nn import RadialConv, RadialGeometry
from cconv.nn.kinds import Kinds, join_kinds
from cconv.nn.radial_conv import MESSAGES
from cconv.ops import blocks, radial_columns, radial_gathers

CHANNELS = [
    ((2, 1), (1, 0)),
    ((2, 1), (0, 1)),
    ((0, 3), (3, 2)),
    ((3, 0), (2, 2)),
    ((1, 2), (25, 30)),
    ((4, 3), (1, 1)),
]
TIGHT = {"rtol": 1e-11, "atol": 1e-11}


def layer_of(generator, channels, dim, *, terms=6, message="absolute", dtype=torch.float64):
    inputs, outputs = (Kinds(*kinds) for kinds in channels)
    return RadialConv(inputs, outputs, terms, dim, bias=False, message=message, generator=generator).to(dtype)


def geometry_of(generator, dim, *, terms=6, window="none", points=60, dtype=torch.float64):
    positions = torch.rand(points, dim, generator=generator, dtype=dtype)
    return RadialGeometry(radius_graph(positions, 0.45), terms, window=window, normalize=window != "none")


def inputs_of(generator, layer, geometry):
    """Features, filters, and a gradient of the output."""
    filters = [each.detach().clone().requires_grad_() for each in (layer.scalar_filters, layer.vector_filters)]
    like = filters[0].detach()
    sizes = (geometry.num_senders, layer.in_channels), (geometry.num_receivers, layer.out_channels)
    features, gradient = (
        torch.randn(count, kinds.num_values(geometry.dim), generator=generator).to(like) for count, kinds in sizes
    )
    return [features.requires_grad_(), *filters], gradient


def fast(layer, geometry, *inputs):
    """The path of compiled loops."""
    assert radial_columns.applies(inputs[0], geometry.weighted_edges)
    return radial_columns.convolve(
        *inputs,
        geometry.weighted_edges,
        MESSAGES[layer.message],
        lambda *given: layer._convolve_generally(*given, geometry),
    )


def both_ways(generator, layer, geometry):
    """Output and all derivatives of both paths."""
    inputs, gradient = inputs_of(generator, layer, geometry)
    outputs = fast(layer, geometry, *inputs), layer._convolve_generally(*inputs, geometry)
    return [
        (output, *torch.autograd.grad(output, inputs, gradient, allow_unused=True, materialize_grads=True))
        for output in outputs
    ]


def assert_alike(found, expected, **tolerances):
    for ours, reference in zip(found, expected, strict=True):
        torch.testing.assert_close(ours, reference, **tolerances)


@pytest.mark.parametrize("message", MESSAGES)
@pytest.mark.parametrize("channels", CHANNELS)
def test_agrees_with_the_general_path(channels, message, generator):
    for dim, window in itertools.product((1, 2, 3), ("none", "poly6")):
        layer = layer_of(generator, channels, dim, message=message)
        assert_alike(*both_ways(generator, layer, geometry_of(generator, dim, window=window)), **TIGHT)


@pytest.mark.parametrize("window", ["gaussian", "cubic_spline"])
def test_agrees_for_the_other_windows(window, generator):
    layer = layer_of(generator, CHANNELS[2], 3, message="opposite")
    assert_alike(*both_ways(generator, layer, geometry_of(generator, 3, window=window)), **TIGHT)


@pytest.mark.parametrize("terms", [1, 2, 8, 40])
def test_agrees_for_any_number_of_terms(terms, generator):
    layer = layer_of(generator, CHANNELS[2], 2, terms=terms, message="mixed")
    assert_alike(*both_ways(generator, layer, geometry_of(generator, 2, terms=terms, window="poly6")), **TIGHT)


@pytest.mark.parametrize("channels", CHANNELS)
def test_single_precision_agrees_with_the_general_path(channels, generator):
    layer = layer_of(generator, channels, 3, message="difference", dtype=torch.float32)
    found, expected = both_ways(generator, layer, geometry_of(generator, 3, points=400, dtype=torch.float32))
    for ours, reference in zip(found, expected, strict=True):
        assert (ours - reference).norm() <= 1e-6 * reference.norm()


@pytest.mark.parametrize("channels", CHANNELS)
def test_agrees_between_two_sets_of_points(channels, generator):
    points, queries = (torch.rand(count, 2, generator=generator, dtype=torch.float64) for count in (30, 20))
    geometry = RadialGeometry(radius_graph(points, 0.3, queries=queries), 6, window="poly6")
    assert_alike(*both_ways(generator, layer_of(generator, channels, 2), geometry), **TIGHT)


def test_points_alone_at_one_place_and_at_the_cutoff(generator):
    positions = torch.tensor([[0, 0, 0], [0, 0, 0], [0.45, 0, 0], [9, 9, 9]], dtype=torch.float64)
    geometry = RadialGeometry(radius_graph(positions, 0.45), 6)
    found, expected = both_ways(generator, layer_of(generator, CHANNELS[2], 3, message="sum"), geometry)
    assert len(geometry.edges) == 6
    assert (found[0][3] == 0).all()
    assert_alike(found, expected, **TIGHT)


@pytest.mark.parametrize("points", [0, 3])
def test_no_edges(points, generator):
    positions = 5 * torch.arange(points, dtype=torch.float64)[:, None].expand(-1, 3)
    geometry = RadialGeometry(radius_graph(positions, 1.0), 6)
    found, expected = both_ways(generator, layer_of(generator, CHANNELS[2], 3, message="mixed"), geometry)
    assert all((each == 0).all() for each in found)
    assert_alike(found, expected)


@pytest.mark.parametrize("needed", list(itertools.product((True, False), repeat=3)))
@pytest.mark.parametrize("channels", [CHANNELS[4], CHANNELS[5]])  # either columns may be the smaller ones
def test_only_what_is_asked_is_differentiated(channels, needed, generator):
    layer, geometry = layer_of(generator, channels, 2, message="mixed"), geometry_of(generator, 2)
    inputs, gradient = inputs_of(generator, layer, geometry)
    expected = torch.autograd.grad(layer._convolve_generally(*inputs, geometry), inputs, gradient)
    inputs = [each.detach().requires_grad_(asked) for each, asked in zip(inputs, needed, strict=True)]
    output = fast(layer, geometry, *inputs)
    assert output.requires_grad == any(needed)
    if any(needed):
        output.backward(gradient)
    for each, asked, derivative in zip(inputs, needed, expected, strict=True):
        assert (each.grad is not None) == asked
        if asked:
            torch.testing.assert_close(each.grad, derivative, **TIGHT)


@pytest.mark.parametrize("message", ["absolute", "mixed"])
def test_derivatives_are_those_of_small_differences(message, generator):
    layer = layer_of(generator, ((2, 1), (1, 2)), 2, terms=3, message=message)
    geometry = geometry_of(generator, 2, terms=3, window="poly6", points=8)
    inputs, _ = inputs_of(generator, layer, geometry)
    assert torch.autograd.gradcheck(lambda *given: fast(layer, geometry, *given), inputs)
    assert torch.autograd.gradgradcheck(lambda *given: fast(layer, geometry, *given), inputs)


def test_agrees_however_the_work_is_cut(generator, monkeypatch, restored_threads):
    layer, geometry = layer_of(generator, CHANNELS[4], 2, message="mixed"), geometry_of(generator, 2, points=300)
    assert geometry.edges.row_splits.diff().max() > radial_gathers.EDGES_AT_A_TIME
    found = []
    for block, per_worker, threads in ((2**21, 2**19, 1), (1, 1, 1), (1, 1, 3)):
        monkeypatch.setattr(blocks, "_BLOCK_BYTES", block)
        monkeypatch.setattr(blocks, "_VALUES_PER_WORKER", per_worker)
        torch.set_num_threads(threads)
        ours, expected = both_ways(torch.Generator().manual_seed(1), layer, geometry)
        assert_alike(ours, expected, **TIGHT)
        found.append(ours)
    assert_alike(found[1], found[0], **TIGHT)
    assert_alike(found[2], found[0], **TIGHT)


def test_same_input_same_bits(generator, monkeypatch, restored_threads):
    """With threads too: which thread sums what does not depend on which is faster."""
    layer = layer_of(generator, CHANNELS[4], 3, message="mixed", dtype=torch.float32)
    geometry = geometry_of(generator, 3, points=400, dtype=torch.float32)
    inputs, gradient = inputs_of(generator, layer, geometry)
    monkeypatch.setattr(blocks, "_VALUES_PER_WORKER", 1)
    torch.set_num_threads(2)
    outputs = [fast(layer, geometry, *inputs) for _ in range(5)]
    first, *others = ([output, *torch.autograd.grad(output, inputs, gradient)] for output in outputs)
    for other in others:
        assert all(torch.equal(one, two) for one, two in zip(first, other, strict=True))


def test_a_layer_keeps_nothing_of_the_size_of_all_edges(generator):
    """Neither for the derivative nor in its geometry: only inputs, and each edge's place in the order by sender."""
    layer, geometry = layer_of(generator, CHANNELS[4], 3, message="mixed"), geometry_of(generator, 3)
    features = inputs_of(generator, layer, geometry)[0][0]
    kept = []

    def keep(tensor):
        kept.append(tensor)
        return tensor

    with torch.autograd.graph.saved_tensors_hooks(keep, lambda tensor: tensor):
        output = layer.convolve(features, geometry)
    output.sum().backward()
    inputs = features, layer.scalar_filters, layer.vector_filters
    assert [tensor.data_ptr() for tensor in kept] == [tensor.data_ptr() for tensor in inputs]
    assert not {"reads", "directions"} & vars(geometry).keys()
    _, order = geometry.weighted_edges.by_sender
    assert order.nbytes == 4 * len(geometry.edges)


def test_differentiated_positions_take_the_general_path(generator):
    positions = torch.rand(20, 2, generator=generator, dtype=torch.float64).requires_grad_()
    features = torch.zeros(20, 4, dtype=torch.float64)
    geometry = RadialGeometry(radius_graph(positions, 0.45), 6, window="poly6")
    assert not radial_columns.applies(features, geometry.weighted_edges)
    fixed = RadialGeometry(radius_graph(positions.detach(), 0.45), 6, window="poly6")
    assert radial_columns.applies(features, fixed.weighted_edges)
    assert not radial_columns.applies(features.half(), fixed.weighted_edges)
    with torch.no_grad():
        assert radial_columns.applies(features, geometry.weighted_edges)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("message", MESSAGES)
def test_wide_layers_predict_what_they_are_trained_on(message, dtype, generator):
    """To the last bit, and without arrays of all pairs."""
    layer = layer_of(generator, ((10, 10), (20, 10)), 2, message=message, dtype=dtype)
    geometry = geometry_of(generator, 2, window="poly6", dtype=dtype)
    features = torch.randn(geometry.num_senders, 30, generator=generator, dtype=dtype)
    with torch.no_grad():
        predicted = layer(features, geometry)
    assert not {"reads", "directions"} & vars(geometry).keys()
    assert torch.equal(predicted, layer(features, geometry))


@pytest.mark.parametrize("message", MESSAGES)
@pytest.mark.parametrize("terms", [1, 7])
def test_columns_times_filters_are_the_convolution(message, terms, generator):
    layer = layer_of(generator, CHANNELS[2], 2, terms=terms, message=message)
    geometry = geometry_of(generator, 2, terms=terms, window="poly6", points=300)
    (features, *filters), _ = inputs_of(generator, layer, geometry)
    columns = layer.columns(features, geometry)
    scalars, vectors = (each @ filter.flatten(0, 1) for each, filter in zip(columns, filters, strict=True))
    product = join_kinds(scalars, vectors.unflatten(0, (-1, 2)).transpose(1, 2))
    torch.testing.assert_close(product, layer(features, geometry), **TIGHT)
