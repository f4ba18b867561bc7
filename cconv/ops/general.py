"""Continuous convolution in torch operations: any device and dtype, differentiable any number of times in everything.

The reference that the other paths are tested against, and the path of second derivatives and compiled graphs.
"""

from torch import Tensor

from cconv.ops.filter_reads import FilterReads


def multiplies_first(num_senders: float, num_receivers: float, in_channels: int, out_channels: int) -> bool:
    """Tell whether to multiply by the filters before gathering: cheaper if C_out is much smaller than C_in."""
    return 4 * num_senders * out_channels <= num_receivers * in_channels


def gather_then_multiply(features: Tensor, filters: Tensor, reads: FilterReads, own: float) -> Tensor:
    """Gather the messages into the filter cells of each receiver, then multiply once by the filters.

    Args:
        features: (M, C_in).
        filters: (K^D, C_in, C_out).
        reads: Where each edge reads the filters.
        own: Message of an edge = sender's features + ``own`` times the receiver's.

    Returns:
        (N, C_out).
    """
    return columns(features, reads, own) @ filters.flatten(0, 1)


def columns(features: Tensor, reads: FilterReads, own: float) -> Tensor:
    """Gather the messages into the filter cells of each receiver, (N, K^D · C_in); arguments as above."""
    messages = features[reads.senders]
    if own:
        messages = messages + own * features[reads.receivers]
    gathered = features.new_zeros(reads.num_receivers * reads.num_cells, features.shape[1])
    for cells, weights in reads.corners():
        gathered.index_add_(0, reads.receivers * reads.num_cells + cells, weights[:, None] * messages)
    return gathered.reshape(reads.num_receivers, reads.num_cells * features.shape[1])


def multiply_then_read(features: Tensor, filters: Tensor, reads: FilterReads, own: float) -> Tensor:
    """Multiply the features of each sender by the filter of every cell, then let the edges read; arguments as above."""
    num_cells, _, out_channels = filters.shape
    products = (features @ filters.transpose(0, 1).flatten(1)).reshape(features.shape[0] * num_cells, out_channels)
    output = features.new_zeros(reads.num_receivers, out_channels)
    for cells, weights in reads.corners():
        messages = products[reads.senders * num_cells + cells]
        if own:
            messages = messages + own * products[reads.receivers * num_cells + cells]
        output.index_add_(0, reads.receivers, weights[:, None] * messages)
    return output
