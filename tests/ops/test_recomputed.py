"""The path of blocks in torch operations against the general one, which keeps everything."""

import itertools
import math

import pytest
import torch
from ops.test_blocked import reads_of, tensors

from cconv.neighbors import radius_graph
from cconv.nn import ConvGeometry, RadialConv, RadialGeometry
from cconv.nn.kinds import Kinds
from cconv.nn.radial_conv import MESSAGES
from cconv.ops import general, recomputed

OWN = (0, -1, 1)
TIGHT = {"atol": 1e-12, "rtol": 1e-12}


@pytest.fixture(params=[math.inf, 700, 1])
def block_values(request, monkeypatch):
    """Everything in one block, some receivers in each, and one in each."""
    monkeypatch.setattr(recomputed, "_BLOCK_VALUES", request.param)


def both(features, filters, gradient, reads, own):
    """Output and derivatives of both paths."""
    for path in (recomputed.convolve, general.gather_then_multiply):
        output = path(features, filters, reads, own)
        yield output, *torch.autograd.grad(output, (features, filters), gradient)


def assert_same(found):
    for ours, reference in zip(*found, strict=True):
        torch.testing.assert_close(ours, reference, **TIGHT)


@pytest.mark.parametrize("dim", [1, 2, 3])
@pytest.mark.parametrize("interpolation", ["linear", "nearest_neighbor", "linear_border"])
def test_agrees_with_the_general_path(dim, interpolation, block_values, generator):
    for own, channels in itertools.product(OWN, [(5, 1), (3, 4)]):
        reads = reads_of(generator, dim, interpolation)
        assert_same(both(*tensors(generator, reads, *channels), reads, own))
    reads = reads_of(generator, dim, interpolation, bipartite=True)
    assert_same(both(*tensors(generator, reads, 3, 4), reads, 0))


def test_receivers_may_have_more_edges_than_a_product_takes(block_values, monkeypatch, generator):
    monkeypatch.setattr(recomputed, "_WIDTH", 5)
    for own in OWN:
        reads = reads_of(generator, 2, "linear")
        assert reads.row_splits.diff().max() > 15
        assert_same(both(*tensors(generator, reads, 3, 4), reads, own))


def test_there_may_be_no_edges_and_no_receivers(generator):
    for points in (0, 3):
        reads = ConvGeometry(radius_graph(10.0 * torch.arange(2.0 * points).reshape(points, 2).double(), 0.4), 3).reads
        assert_same(both(*tensors(generator, reads, 3, 4), reads, -1))


@pytest.mark.parametrize("needed", [0, 1])
def test_either_derivative_alone(needed, block_values, generator):
    reads = reads_of(generator, 2, "linear")
    *inputs, gradient = tensors(generator, reads, 3, 4)
    inputs[1 - needed].requires_grad_(False)
    found, expected = (
        torch.autograd.grad(path(*inputs, reads, -1), inputs[needed], gradient)[0]
        for path in (recomputed.convolve, general.gather_then_multiply)
    )
    torch.testing.assert_close(found, expected, **TIGHT)


def test_derivatives_of_everything_are_those_of_finite_differences(block_values, generator):
    """Positions too, and second derivatives."""
    points = torch.rand(7, 2, generator=generator, dtype=torch.float64).requires_grad_()
    features = torch.randn(7, 2, generator=generator, dtype=torch.float64).requires_grad_()
    filters = torch.randn(9, 2, 2, generator=generator, dtype=torch.float64).requires_grad_()

    def output(points, features, filters):
        return recomputed.convolve(features, filters, ConvGeometry(radius_graph(points, 0.6), 3).reads, -1)

    assert torch.autograd.gradcheck(output, (points, features, filters))
    assert torch.autograd.gradgradcheck(output, (points, features, filters))


RADIAL = [((2, 1), (1, 0)), ((0, 3), (3, 2)), ((3, 0), (2, 2)), ((1, 2), (0, 3))]


def radial_layer(generator, channels, dim, message):
    inputs, outputs = (Kinds(*kinds) for kinds in channels)
    return RadialConv(inputs, outputs, 4, dim, bias=False, message=message, generator=generator).double()


@pytest.mark.parametrize("channels", RADIAL, ids=str)
@pytest.mark.parametrize("dim", [1, 2, 3])
def test_radial_layers_agree_with_the_general_path(channels, dim, block_values, generator):
    points = torch.rand(30, dim, generator=generator, dtype=torch.float64)
    for message in MESSAGES:
        layer = radial_layer(generator, channels, dim, message)
        geometry = RadialGeometry(radius_graph(points, 0.45), 4, window="poly6", normalize=True)
        given = [torch.randn(30, layer.in_channels.num_values(dim), generator=generator, dtype=torch.float64)]
        given = [each.detach().requires_grad_() for each in (*given, layer.scalar_filters, layer.vector_filters)]
        found = []
        for path in (layer._convolve_by_blocks, layer._convolve_generally):
            output = path(*given, geometry)
            derived = torch.autograd.grad(output.square().sum(), given, allow_unused=True)
            found.append([output, *(each for each in derived if each is not None and each.numel())])
        assert_same(found)


def test_derivatives_of_radial_layers_are_those_of_finite_differences(block_values, generator):
    layer = radial_layer(generator, ((1, 1), (1, 1)), 2, "mixed")
    points = torch.rand(6, 2, generator=generator, dtype=torch.float64).requires_grad_()
    given = [torch.randn(6, 3, generator=generator, dtype=torch.float64), layer.scalar_filters, layer.vector_filters]

    def output(points, *given):
        return layer._convolve_by_blocks(*given, RadialGeometry(radius_graph(points, 0.6), 4, window="poly6"))

    inputs = points, *(each.detach().requires_grad_() for each in given)
    assert torch.autograd.gradcheck(output, inputs)
