import pytest
import torch

from cconv.ops import products


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize(("rows", "inner", "columns"), [(1, 1, 1), (7, 300, 5), (64, 40, 96), (0, 3, 2), (3, 0, 2)])
def test_product_with_the_transpose(rows, inner, columns, dtype, generator):
    values = torch.randn(rows, inner, generator=generator, dtype=torch.float64)
    weights = torch.randn(columns, inner, generator=generator, dtype=torch.float64)
    found = products.linear(values.to(dtype), weights.to(dtype))
    assert found.dtype == dtype
    torch.testing.assert_close(found.double(), values @ weights.T, atol=1e-4, rtol=1e-4)


def test_transposed_views(generator):
    left, right = torch.randn(20, 7, generator=generator), torch.randn(20, 30, generator=generator)
    torch.testing.assert_close(products.linear(left.T, right.T), left.T @ right, atol=1e-5, rtol=1e-5)


def test_not_finite_values_pass_on():
    values = torch.tensor([[1.0, float("nan")], [float("inf"), 1.0], [1.0, 1.0]])
    found = products.linear(values, torch.ones(1, 2))
    assert torch.isnan(found[0])
    assert torch.isinf(found[1])
    assert found[2] == 2


def test_without_onednn_it_is_the_same(monkeypatch, generator):
    monkeypatch.setattr(torch.backends.mkldnn, "is_available", lambda: False)
    values, weights = torch.randn(9, 4, generator=generator), torch.randn(3, 4, generator=generator)
    torch.testing.assert_close(products._onednn_linear()(values, weights), products.linear(values, weights))
