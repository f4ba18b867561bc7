import pytest
import torch

from cconv.ops.sparse_rows import SparseRows


@pytest.fixture
def entries(generator):
    rows, columns = torch.randint(6, (30,), generator=generator), torch.randint(4, (30,), generator=generator)
    return rows, columns, torch.randn(30, generator=generator, dtype=torch.float64)


def dense_of(rows, columns, values, shape):
    return torch.zeros(shape, dtype=values.dtype).index_put_((rows, columns), values, accumulate=True)


def test_product_and_transpose_agree_with_the_dense_matrix(entries, generator):
    matrix, dense = SparseRows.from_entries(*entries, (6, 4)), dense_of(*entries, (6, 4))
    right, left = (torch.randn(size, 3, generator=generator, dtype=torch.float64) for size in (4, 6))
    torch.testing.assert_close(matrix @ right, dense @ right)
    torch.testing.assert_close(matrix.transposed @ left, dense.T @ left)


def test_gradients_of_first_and_second_order(entries, generator):
    matrix = SparseRows.from_entries(*entries, (6, 4))
    right = torch.randn(4, 2, generator=generator, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(lambda x: matrix @ x, (right,))
    assert torch.autograd.gradgradcheck(lambda x: (matrix @ x) ** 2, (right,))


def test_empty_matrix_gives_zeros():
    nothing = torch.zeros(0, dtype=torch.int64)
    matrix = SparseRows.from_entries(nothing, nothing, torch.zeros(0), (3, 2))
    assert torch.equal(matrix @ torch.ones(2, 4), torch.zeros(3, 4))
