"""The general path beyond what `test_blocked` and the oracle in `tests/nn` hold it to: other devices and dtypes."""

import pytest
import torch

from cconv.neighbors import radius_graph
from cconv.nn import ContinuousConv, ConvGeometry
from cconv.ops import general


@pytest.mark.parametrize("order", ["gather_then_multiply", "multiply_then_read"])
def test_bfloat16(order, generator):
    edges = radius_graph(torch.rand(50, 3, generator=generator), 0.4)
    features, filters = torch.randn(50, 4, generator=generator), torch.randn(64, 4, 3, generator=generator)
    expected = getattr(general, order)(features, filters, ConvGeometry(edges, 4).reads, 0)
    reads = ConvGeometry(edges.to(torch.bfloat16), 4).reads
    found = getattr(general, order)(features.bfloat16(), filters.bfloat16(), reads, 0)
    assert found.dtype == torch.bfloat16
    assert (found.float() - expected).norm() < 0.1 * expected.norm()


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU")
@pytest.mark.parametrize("message", ["absolute", "difference"])
def test_gpu_agrees_with_the_cpu(message, generator):
    positions = torch.rand(200, 3, generator=generator, dtype=torch.float64)
    features = torch.randn(200, 4, generator=generator, dtype=torch.float64)
    layer = ContinuousConv(4, 5, 4, 3, message=message, generator=generator).double()
    outputs, gradients = [], []
    for device in ("cpu", "cuda"):
        layer = layer.to(device)
        at = positions.to(device).requires_grad_()
        output = layer(features.to(device), ConvGeometry(radius_graph(at, 0.3), 4))
        outputs.append(output.cpu())
        gradients.append([g.cpu() for g in torch.autograd.grad(output.square().sum(), (at, layer.filters))])
    torch.testing.assert_close(outputs[1], outputs[0])
    torch.testing.assert_close(gradients[1], gradients[0])
