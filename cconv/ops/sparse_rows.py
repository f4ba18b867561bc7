"""Product of a constant sparse matrix with a dense one, differentiable any number of times in the dense one."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy.sparse
import torch
import torch.nn.functional as F
from torch import Tensor


@dataclass(frozen=True)
class SparseRows:
    """A constant sparse matrix in compressed rows.

    Attributes:
        offsets: Entries of row r stand at ``offsets[r]:offsets[r + 1]``, (rows + 1,), int32.
        columns: Column of each entry, (entries,), int32.
        values: Value of each entry, (entries,).
        num_columns: Number of columns.
    """

    offsets: Tensor
    columns: Tensor
    values: Tensor
    num_columns: int

    @classmethod
    def from_entries(cls, rows: Tensor, columns: Tensor, values: Tensor, shape: tuple[int, int]) -> "SparseRows":
        """Matrix of `shape` from entries in any order; entries at the same place are added."""
        coordinates = (rows.cpu().numpy(), columns.cpu().numpy())
        matrix = scipy.sparse.coo_array((values.cpu().numpy(), coordinates), shape=shape).tocsr()
        return cls._from_scipy(matrix.indptr, matrix.indices, matrix.data, shape[1], values.device)

    @classmethod
    def _from_scipy(cls, indptr, indices, data, num_columns: int, device: torch.device) -> "SparseRows":
        offsets, columns = (torch.from_numpy(array.astype(np.int32, copy=False)) for array in (indptr, indices))
        return cls(offsets.to(device), columns.to(device), torch.from_numpy(data).to(device), num_columns)

    @property
    def num_rows(self) -> int:
        """Number of rows."""
        return len(self.offsets) - 1

    @cached_property
    def transposed(self) -> "SparseRows":
        """The transposed matrix."""
        arrays = (self.values.cpu().numpy(), self.columns.cpu().numpy(), self.offsets.cpu().numpy())
        matrix = scipy.sparse.csr_array(arrays, shape=(self.num_rows, self.num_columns)).tocsc()
        return self._from_scipy(matrix.indptr, matrix.indices, matrix.data, self.num_rows, self.values.device)

    def __matmul__(self, dense: Tensor) -> Tensor:
        """Product with `dense` (columns, C): (rows, C)."""
        return _SparseProduct.apply(dense, self)


class _SparseProduct(torch.autograd.Function):
    """``A @ x``; its derivative ``A^T @ g`` is again such a product, so higher derivatives come for free."""

    @staticmethod
    def forward(ctx, dense: Tensor, matrix: SparseRows) -> Tensor:
        ctx.matrix = matrix
        if len(matrix.columns) == 0 or dense.shape[1] == 0:
            return dense.new_zeros(matrix.num_rows, dense.shape[1])
        return F.embedding_bag(
            matrix.columns,
            dense.contiguous(),
            matrix.offsets,
            mode="sum",
            per_sample_weights=matrix.values,
            include_last_offset=True,
        )

    @staticmethod
    def backward(ctx, gradient: Tensor) -> tuple[Tensor, None]:
        return ctx.matrix.transposed @ gradient, None
