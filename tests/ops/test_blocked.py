"""The fast path against the general one."""

import itertools
import subprocess
import sys

import pytest
import torch

from cconv.neighbors import radius_graph
from cconv.nn import ConvGeometry
from cconv.ops import blocked, blocks, general

ORDERS = ("gather_then_multiply", "multiply_then_read")
OWN = (0, -1, 1)


@pytest.fixture(params=["linear", "nearest_neighbor", "linear_border"])
def interpolation(request):
    return request.param


def reads_of(generator, dim, interpolation, bipartite=False, num_points=40):
    points = torch.rand(num_points, dim, generator=generator, dtype=torch.float64)
    queries = torch.rand(25, dim, generator=generator, dtype=torch.float64) if bipartite else None
    edges = radius_graph(points, 0.4, queries=queries)
    sizes = (3, 4, 2)[:dim]
    return ConvGeometry(edges, sizes, "identity", interpolation=interpolation, align_corners=False).reads


def tensors(generator, reads, in_channels, out_channels):
    def normal(*shape):
        return torch.randn(*shape, generator=generator, dtype=torch.float64)

    return (
        normal(reads.num_senders, in_channels).requires_grad_(),
        normal(reads.num_cells, in_channels, out_channels).requires_grad_(),
        normal(reads.num_receivers, out_channels),
    )


def output_and_gradients(path, order, features, filters, gradient, reads, own):
    output = getattr(path, order)(features, filters, reads, own)
    return output, *torch.autograd.grad(output, (features, filters), gradient)


@pytest.mark.parametrize("dim", [1, 2, 3])
@pytest.mark.parametrize("channels", [(5, 1), (3, 4), (1, 6)])
def test_agrees_with_the_general_path(channels, dim, interpolation, generator):
    for order, own in itertools.product(ORDERS, OWN):
        reads = reads_of(generator, dim, interpolation)
        inputs = tensors(generator, reads, *channels)
        found = output_and_gradients(blocked, order, *inputs, reads, own)
        expected = output_and_gradients(general, order, *inputs, reads, own)
        for ours, reference in zip(found, expected, strict=True):
            torch.testing.assert_close(ours, reference, atol=1e-12, rtol=1e-12)


@pytest.mark.parametrize("channels", [(5, 1), (3, 4), (1, 6)])
def test_agrees_between_two_sets_of_points(channels, interpolation, generator):
    for order in ORDERS:
        reads = reads_of(generator, 2, interpolation, bipartite=True)
        inputs = tensors(generator, reads, *channels)
        found = output_and_gradients(blocked, order, *inputs, reads, 0)
        expected = output_and_gradients(general, order, *inputs, reads, 0)
        for ours, reference in zip(found, expected, strict=True):
            torch.testing.assert_close(ours, reference, atol=1e-12, rtol=1e-12)


def test_agrees_however_the_work_is_cut(generator, monkeypatch, restored_threads):
    reads = reads_of(generator, 3, "linear", num_points=200)
    expected = {}
    for block, products, per_worker, threads in ((2**21, 2**25, 2**18, 1), (1, 1, 1, 1), (1, 1000, 1, 2)):
        monkeypatch.setattr(blocks, "_BLOCK_BYTES", block)
        monkeypatch.setattr(blocked, "_PRODUCT_BYTES", products)
        monkeypatch.setattr(blocks, "_VALUES_PER_WORKER", per_worker)
        torch.set_num_threads(threads)
        for order, own, channels in itertools.product(ORDERS, OWN, [(5, 1), (3, 4), (1, 6)]):
            inputs = tensors(torch.Generator().manual_seed(1), reads, *channels)
            found = output_and_gradients(blocked, order, *inputs, reads, own)
            for ours, reference in zip(found, expected.setdefault((order, own, channels), found), strict=True):
                torch.testing.assert_close(ours, reference, atol=1e-12, rtol=1e-12)


@pytest.mark.parametrize("needed", [0, 1])
def test_either_gradient_alone(needed, generator):
    reads = reads_of(generator, 2, "linear")
    for channels in [(5, 1), (3, 4), (1, 6)]:
        *inputs, gradient = tensors(generator, reads, *channels)
        inputs[1 - needed].requires_grad_(False)
        found, expected = (
            torch.autograd.grad(path.gather_then_multiply(*inputs, reads, -1), inputs[needed], gradient)[0]
            for path in (blocked, general)
        )
        torch.testing.assert_close(found, expected)


def test_same_input_same_bits(generator):
    """With threads too: which thread sums what does not depend on which is faster."""
    reads = reads_of(generator, 3, "linear", num_points=400)
    inputs = [tensor.float() for tensor in tensors(generator, reads, 8, 8)]
    reads = ConvGeometry(radius_graph(torch.rand(400, 3, generator=generator), 0.3), (3, 4, 2)).reads
    inputs[0], inputs[1] = inputs[0].detach().requires_grad_(), inputs[1].detach().requires_grad_()
    first, *others = (output_and_gradients(blocked, "gather_then_multiply", *inputs, reads, 0) for _ in range(5))
    for other in others:
        assert all(torch.equal(one, two) for one, two in zip(first, other, strict=True))


def test_inference_mode(generator):
    reads = reads_of(generator, 3, "linear", num_points=200)
    features, filters, _ = tensors(generator, reads, 3, 4)
    for order in ORDERS:
        expected = getattr(general, order)(features, filters, reads, 0)
        with torch.inference_mode():
            found = getattr(blocked, order)(features.clone(), filters.clone(), reads, 0)
            torch.testing.assert_close(found, expected.detach())


def test_nan_of_diverged_weights_passes_on(generator):
    reads = reads_of(generator, 3, "linear")
    features, filters, _ = tensors(generator, reads, 3, 4)
    with torch.no_grad():
        filters.fill_(float("nan"))
    for order in ORDERS:
        output = getattr(blocked, order)(features, filters, reads, 0)
        assert torch.isnan(output[reads.row_splits.diff() > 0]).all()


COLD_AND_WARM = """
import torch
from cconv.neighbors import radius_graph
from cconv.nn import ConvGeometry
from cconv.ops import blocked, gathers

reads = ConvGeometry(radius_graph(torch.rand(20, 2), 0.4), 3).reads
for own in (0, -1):
    features, filters = torch.rand(20, 2, requires_grad=True), torch.rand(9, 2, 2, requires_grad=True)
    blocked.gather_then_multiply(features, filters, reads, own).sum().backward()
    blocked.multiply_then_read(features, filters, reads, own).sum().backward()
loops = (gathers.gather, gathers.gather_with_own, gathers.add_own, gathers.read, gathers.sort_by_sender)
print(sum(sum(loop.stats.cache_misses.values()) for loop in loops))
print(sum(sum(loop.stats.cache_hits.values()) for loop in loops))
"""


@pytest.mark.slow
def test_a_second_process_compiles_nothing(tmp_path, monkeypatch):
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))
    counts = []
    for _ in range(2):
        finished = subprocess.run([sys.executable, "-c", COLD_AND_WARM], capture_output=True, text=True, check=True)
        counts.append([int(count) for count in finished.stdout.split()])
    (compiled, _), (compiled_again, loaded) = counts
    assert compiled == loaded > 0
    assert compiled_again == 0
