"""The choice among the paths of a continuous convolution, by where its tensors are and what is to be derived."""

import torch
from torch import Tensor

from cconv.ops import blocked, general, recomputed
from cconv.ops.filter_reads import FilterReads
from cconv.ops.workers import runs_compiled


def convolve(features: Tensor, filters: Tensor, reads: FilterReads, own: float = 0) -> Tensor:
    """Sum over the edges of each receiver of window · filterᵀ · message.

    Args:
        features: (M, C_in).
        filters: (K^D, C_in, C_out).
        reads: Where each edge reads the filters.
        own: Message of an edge = sender's features + ``own`` times the receiver's.

    Returns:
        (N, C_out).
    """
    if recomputed.applies(features):
        return recomputed.convolve(features, filters, reads, own)
    path = blocked if _is_fast(features, reads) else general
    if _multiplies_first(reads, *filters.shape[1:]):
        return path.multiply_then_read(features, filters, reads, own)
    return path.gather_then_multiply(features, filters, reads, own)


def columns(features: Tensor, reads: FilterReads, own: float = 0) -> Tensor:
    """Gather the messages into the filter cells of each receiver, (N, K^D · C_in), not differentiable.

    With filters flattened to (K^D · C_in, C_out), ``columns(...) @ filters`` is the convolution. Arguments as above.
    """
    path = blocked if _is_fast(features, reads) else general
    with torch.no_grad():
        return path.columns(features, reads, own)


def _multiplies_first(reads: FilterReads, in_channels: int, out_channels: int) -> bool:
    """Whether that is cheaper; a compiled graph serves any numbers of points, and cannot ask for them."""
    if torch.compiler.is_compiling():
        return False
    return general.multiplies_first(reads.num_senders, reads.num_receivers, in_channels, out_channels)


def _is_fast(features: Tensor, reads: FilterReads) -> bool:
    return runs_compiled(features) and not reads.requires_grad
