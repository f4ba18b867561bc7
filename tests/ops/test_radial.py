"""The path of few outputs against the general one."""

import itertools

import pytest
import torch

from cconv.neighbors import radius_graph
from cconv.nn import RadialConv, RadialGeometry
from cconv.nn.kinds import Kinds
from cconv.ops import radial

CHANNELS = [((2, 1), (1, 0)), ((2, 1), (0, 1)), ((0, 3), (3, 2)), ((3, 0), (2, 2)), ((1, 2), (20, 0))]


def case(generator, channels, dim=3, *, terms=6, message="absolute", window="none", points=60, dtype=torch.float64):
    positions = torch.rand(points, dim, generator=generator, dtype=dtype)
    inputs, outputs = (Kinds(*kinds) for kinds in channels)
    layer = RadialConv(inputs, outputs, terms, dim, bias=False, message=message, generator=generator).to(dtype)
    geometry = RadialGeometry(radius_graph(positions, 0.45), terms, window=window, normalize=window != "none")
    features = torch.randn(points, inputs.num_values(dim), generator=generator, dtype=dtype)
    return layer, features, geometry


@torch.no_grad()
def both_ways(layer, features, geometry):
    filters = layer.scalar_filters, layer.vector_filters
    assert radial.applies(features, *filters, geometry.edges)
    assert "reads" not in vars(geometry)
    found = layer(features, geometry)
    assert "reads" not in vars(geometry)  # what the general path needs was not made
    return found, layer._convolve_generally(features, *filters, geometry)


@pytest.mark.parametrize("message", ["absolute", "difference", "sum", "mixed", "opposite"])
@pytest.mark.parametrize("channels", CHANNELS)
def test_agrees_with_the_general_path(channels, message, generator):
    for dim, window in itertools.product((1, 2, 3), ("none", "poly6")):
        found, expected = both_ways(*case(generator, channels, dim, message=message, window=window))
        torch.testing.assert_close(found, expected, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("channels", CHANNELS)
def test_single_precision_agrees_with_the_general_path(channels, generator):
    found, expected = both_ways(*case(generator, channels, message="difference", points=400, dtype=torch.float32))
    assert (found - expected).abs().max() <= 1e-6 * expected.abs().max()


@pytest.mark.parametrize("terms", [1, 2, 40])
def test_agrees_for_any_number_of_terms(terms, generator):
    found, expected = both_ways(*case(generator, CHANNELS[0], terms=terms))
    torch.testing.assert_close(found, expected, rtol=1e-12, atol=1e-12)


def test_agrees_between_two_sets_of_points(generator):
    layer, _, _ = case(generator, ((1, 1), (2, 1)), 2)
    points, queries = (torch.rand(count, 2, generator=generator, dtype=torch.float64) for count in (30, 20))
    features = torch.randn(30, 3, generator=generator, dtype=torch.float64)
    found, expected = both_ways(layer, features, RadialGeometry(radius_graph(points, 0.3, queries=queries), 6))
    assert found.shape == (20, 4)
    torch.testing.assert_close(found, expected, rtol=1e-12, atol=1e-12)


def test_agrees_however_the_edges_are_cut(generator, monkeypatch):
    """Rows longer than a piece, pieces that end with a row, and more threads than rows with edges."""
    layer, features, geometry = case(generator, CHANNELS[0], 2, points=700)
    assert geometry.edges.row_splits.diff().max() > 2 * radial.EDGES_AT_A_TIME // 5
    found, expected = both_ways(layer, features, geometry)
    torch.testing.assert_close(found, expected, rtol=1e-12, atol=1e-12)
    threads = torch.get_num_threads()
    monkeypatch.setattr(radial, "_READS_PER_WORKER", 1)
    try:
        torch.set_num_threads(3)
        with torch.no_grad():
            shared = layer(features, geometry)
    finally:
        torch.set_num_threads(threads)
    torch.testing.assert_close(shared, expected, rtol=1e-12, atol=1e-12)


def test_points_at_one_place_and_at_the_cutoff(generator):
    layer, _, _ = case(generator, CHANNELS[2])
    positions = torch.tensor([[0, 0, 0], [0, 0, 0], [0.45, 0, 0], [9, 9, 9]], dtype=torch.float64)
    features = torch.randn(4, 9, generator=generator, dtype=torch.float64)
    geometry = RadialGeometry(radius_graph(positions, 0.45), 6)
    assert len(geometry.edges) == 6
    found, expected = both_ways(layer, features, geometry)
    assert (found[3] == 0).all()
    torch.testing.assert_close(found, expected, rtol=1e-12, atol=1e-12)


def test_no_points(generator):
    layer, _, _ = case(generator, CHANNELS[0])
    nowhere = torch.zeros(0, 3, dtype=torch.float64)
    found, _ = both_ways(layer, torch.zeros(0, 5, dtype=torch.float64), RadialGeometry(radius_graph(nowhere, 1.0), 6))
    assert found.shape == (0, 1)


def test_applies_where_nothing_is_differentiated_and_reads_are_few(generator):
    layer, features, geometry = case(generator, CHANNELS[0])
    filters = layer.scalar_filters, layer.vector_filters
    assert not radial.applies(features, *filters, geometry.edges)  # the filters are to be learned
    fixed = [each.detach() for each in filters]
    assert radial.applies(features, *fixed, geometry.edges)
    assert not radial.applies(features.clone().requires_grad_(), *fixed, geometry.edges)
    assert not radial.applies(features.half(), *fixed, geometry.edges)
    wide = torch.zeros(6, 3, radial.MOST_READS // 3 + 1, dtype=torch.float64)  # two scalars and a vector
    assert radial.applies(features, wide[:, :, 1:], fixed[1], geometry.edges)
    assert not radial.applies(features, wide, fixed[1], geometry.edges)
    with torch.inference_mode():
        assert radial.applies(features, *filters, geometry.edges)
