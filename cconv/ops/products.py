"""Matrix products at the speed of the machine.

`torch.mm` calls MKL on x86, which leaves AVX-512 unused on CPUs that are not Intel's: half of the speed on an AMD EPYC.
oneDNN, which comes with torch too, uses it everywhere. Torch reaches oneDNN's product of dense float32 matrices only
through the operator that its own compiler calls; where that is missing, `torch.nn.functional.linear` does the same.
"""

from collections.abc import Callable

import torch
import torch.nn.functional as F
from torch import Tensor


def linear(values: Tensor, weights: Tensor) -> Tensor:
    """``values @ weights.T`` of matrices (R, P) and (C, P) on the CPU, not differentiable."""
    if values.dtype == torch.float32 and values.numel() and weights.numel():
        return _float32_linear(values, weights)
    return F.linear(values, weights)


def _onednn_linear() -> Callable[[Tensor, Tensor], Tensor]:
    operator = getattr(torch.ops.mkldnn, "_linear_pointwise", None)
    if operator is None or not torch.backends.mkldnn.is_available():
        return F.linear
    return lambda values, weights: operator(values, weights, None, "none", [], "")


_float32_linear = _onednn_linear()
