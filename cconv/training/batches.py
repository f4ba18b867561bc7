"""Batch order: a stateless permutation of (data seed, epoch), the same for every trial, process and restart."""

from collections.abc import Iterator
from itertools import count

import numpy as np


def epoch_order(num_samples: int, data_seed: int, epoch: int) -> np.ndarray:
    """Return the order of the samples in an epoch, a permutation of ``range(num_samples)``."""
    return np.random.default_rng([data_seed, epoch]).permutation(num_samples)


def batches(num_samples: int, batch_size: int, data_seed: int) -> Iterator[list[int]]:
    """Yield batches of sample indices without end; the last batch of an epoch may be smaller."""
    for epoch in count():
        order = epoch_order(num_samples, data_seed, epoch).tolist()
        for start in range(0, num_samples, batch_size):
            yield order[start : start + batch_size]
