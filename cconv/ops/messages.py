"""Message passing on the CPU, a few hundred pairs at a time, so that what a pair passes through stays in the cache.

For each block of receivers: the first layer of the perceptron of the pairs, to which the products of both particles
are added, its other layers, the normalisation, and at once the sums of the receivers and the update of the pairs.
Nothing is differentiable.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numba import uintp
from torch import Tensor

from cconv.compiled import compile_cached
from cconv.ops.blocks import for_ranges
from cconv.ops.workers import runs_compiled

_compile = compile_cached(nogil=True, fastmath={"contract", "reassoc"}, error_model="numpy")

PAIRS_AT_A_TIME = 512
_MULTIPLICATIONS_OF_A_VALUE = 32  # of a matrix product that take about as long as a value to set or read


@dataclass(frozen=True, kw_only=True)
class PairLayers:
    """Weights of a perceptron of pairs, whose last layer is followed by a normalisation.

    Attributes:
        first: Weights (H, C) of the first layer for what a pair has itself.
        following: Weights (H', H) and biases (H') of each further layer.
        activation: After each layer but the last.
        scale: Of the normalised values (H,).
        offset: Of the normalised values (H,).
        smallest: What is added to the variance.
    """

    first: Tensor
    following: Sequence[tuple[Tensor, Tensor]]
    activation: Callable[[Tensor], Tensor]
    scale: Tensor
    offset: Tensor
    smallest: float


def applies(*values: Tensor) -> bool:
    """Tell whether `pass_messages` can be used: nothing to differentiate, the CPU."""
    differentiated = torch.is_grad_enabled() and any(each.requires_grad for each in values)
    return not differentiated and all(runs_compiled(each) for each in values)


def by_rows(function: Callable[[int, int], Tensor], output: Tensor, multiplications: int) -> Tensor:
    """Set rows that threads compute, each a range of them in one piece; torch's own threads are not woken.

    Args:
        function: First row and the one after the last to the values of the rows between, (rows, C).
        output: What is set, (N, C).
        multiplications: Of a row.

    Returns:
        The output.
    """

    def visit(first: int, last: int) -> None:
        output[first:last] = function(first, last)

    for_ranges(len(output), len(output) * multiplications // _MULTIPLICATIONS_OF_A_VALUE, visit)
    return output


def pass_messages(
    pairs: Tensor, of_senders: Tensor, of_receivers: Tensor, senders: Tensor, row_splits: Tensor, layers: PairLayers
) -> Tensor:
    """Sum the messages to each receiver, and add the message of each pair to its values in place.

    Args:
        pairs: Values (E, C) of the pairs, sorted by receiver; C = H of the last layer.
        of_senders: Products (M, H) of the particles as senders with the first layer.
        of_receivers: Products (N, H) of the particles as receivers, bias included.
        senders: Sender of each pair (E,).
        row_splits: Pairs of receiver i stand at ``row_splits[i]:row_splits[i + 1]``, (N + 1,).
        layers: Weights of the perceptron.

    Returns:
        Sums (N, C).
    """
    sums = torch.zeros(len(of_receivers), pairs.shape[1], dtype=pairs.dtype)
    splits = row_splits.numpy()
    with torch.no_grad():
        first_layer, following = layers.first.T, [(weights.T, bias) for weights, bias in layers.following]
        given = [tensor.detach().numpy() for tensor in (of_senders, of_receivers, senders)]
        ending = [tensor.detach().numpy() for tensor in (layers.scale, layers.offset)]

        def visit(first: int, last: int) -> None:
            for begin, end in _blocks(splits, first, last):
                known = pairs[splits[begin] : splits[end]]
                values = torch.mm(known, first_layer)
                _add_products(begin, end, splits, *given, values.numpy())
                for weights, bias in following:
                    values = torch.addmm(bias, layers.activation(values), weights)
                _normalize_and_add(
                    begin, end, splits, *ending, layers.smallest, values.numpy(), known.numpy(), sums.numpy()
                )

        multiplications = len(pairs) * sum(weights.numel() for weights, _ in [(first_layer, None), *following])
        for_ranges(len(of_receivers), multiplications // _MULTIPLICATIONS_OF_A_VALUE, visit)
    return sums


def _blocks(splits: np.ndarray, first: int, last: int) -> list[tuple[int, int]]:
    """Ranges of receivers from `first` to `last` with about as many pairs as a core's cache holds, none empty."""
    ends = np.searchsorted(splits[first : last + 1], np.arange(splits[first], splits[last], PAIRS_AT_A_TIME)) + first
    bounds = sorted({first, last, *ends.tolist()})
    return [(begin, end) for begin, end in zip(bounds[:-1], bounds[1:], strict=True) if splits[begin] < splits[end]]


@_compile
def _add_products(begin, end, splits, of_senders, of_receivers, senders, values):
    """Add to the values of each pair the products of its sender and of its receiver."""
    width, start = uintp(values.shape[1]), splits[begin]
    for row in range(begin, end):
        received = of_receivers[row]
        for pair in range(splits[row], splits[row + 1]):
            here, sent = values[pair - start], of_senders[uintp(senders[pair])]
            for c in range(width):
                here[c] += sent[c] + received[c]


@_compile
def _normalize_and_add(begin, end, splits, scale, offset, smallest, values, pairs, sums):
    """Normalise the values of each pair, and add them to the pair and to the sum of its receiver."""
    width, start = uintp(values.shape[1]), splits[begin]
    share, zero = values.dtype.type(1) / values.dtype.type(values.shape[1]), values.dtype.type(0)
    for row in range(begin, end):
        total = sums[row]
        for pair in range(splits[row], splits[row + 1]):
            here, known = values[pair - start], pairs[pair - start]
            mean = zero
            for c in range(width):
                mean += here[c]
            mean *= share
            variance = zero
            for c in range(width):
                apart = here[c] - mean
                variance += apart * apart
            factor = values.dtype.type(1) / np.sqrt(variance * share + values.dtype.type(smallest))
            for c in range(width):
                message = (here[c] - mean) * factor * scale[c] + offset[c]
                known[c] += message
                total[c] += message
