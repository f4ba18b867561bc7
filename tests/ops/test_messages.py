"""Messages block by block are those of torch's operations, whatever the sizes."""

import pytest
import torch

from cconv.neighbors import radius_graph
from cconv.nn.message_passing import MessagePassing
from cconv.ops import messages
from cconv.ops.workers import torch_threads


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("threads", [1, 2])
@pytest.mark.parametrize(("particles", "width", "cutoff"), [(1, 3, 0.1), (40, 7, 0.5), (900, 64, 0.12), (60, 5, 1e-3)])
def test_a_step_without_derivatives_is_that_with_them(particles, width, cutoff, threads, dtype, generator):
    edges = radius_graph(torch.rand(particles, 2, generator=generator, dtype=dtype), cutoff)
    step = MessagePassing(width, [width + 1, width], "tanh", generator).to(dtype)
    values = torch.randn(particles, width, generator=generator, dtype=dtype)
    pairs = torch.randn(len(edges), width, generator=generator, dtype=dtype)
    expected = step(values, pairs, edges)
    assert expected[0].requires_grad
    with torch_threads(threads), torch.no_grad():
        found = step(values, pairs.clone(), edges)
    tolerance = 1e-5 if dtype == torch.float32 else 1e-12
    for ours, theirs in zip(found, expected, strict=True):
        torch.testing.assert_close(ours, theirs.detach(), atol=tolerance * 10, rtol=tolerance)


def test_it_is_not_used_where_something_is_differentiated():
    weights = torch.ones(2, requires_grad=True)
    assert not messages.applies(torch.ones(2), weights)
    with torch.no_grad():
        assert messages.applies(torch.ones(2), weights)
    assert not messages.applies(torch.ones(2, dtype=torch.bfloat16))
