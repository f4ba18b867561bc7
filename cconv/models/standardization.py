"""Shift and scale of features and targets, from the training split only."""

from collections.abc import Iterable
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from cconv.nn.kinds import Kinds
from cconv.tasks.features import CONSTANT
from cconv.tasks.inputs import Features


@dataclass(frozen=True)
class Standardization:
    """Shift and scale: ``(value - mean) / scale``.

    Attributes:
        mean: (C,).
        scale: (C,), positive.
    """

    mean: Float[Tensor, " C"]
    scale: Float[Tensor, " C"]


class Moments:
    """Means and variances of columns over frames that are seen one at a time.

    Source: Chan, Golub, LeVeque, "Updating formulae and a pairwise algorithm for computing sample variances" (1979).
    """

    def __init__(self) -> None:
        self._count, self._mean, self._squares = 0, torch.zeros(()), torch.zeros(())

    def add(self, values: Float[Tensor, "N C"]) -> None:
        """Take in the values (N, C) of a frame."""
        values, count = values.double(), self._count + len(values)
        if len(values) == 0:
            return
        mean = values.mean(dim=0)
        squares, apart = (values - mean).square().sum(dim=0), mean - self._mean.to(mean)
        self._squares = self._squares.to(mean) + squares + apart.square() * (self._count * len(values) / count)
        self._mean = self._mean.to(mean) + apart * (len(values) / count)
        self._count = count

    @property
    def mean(self) -> Float[Tensor, " C"]:
        """Mean of each column."""
        return self._mean

    @property
    def variance(self) -> Float[Tensor, " C"]:
        """Variance of each column, of the values as a whole population."""
        return self._squares / max(self._count, 1)

    def standardization(self, columns: slice = slice(None), center: bool = True) -> Standardization:
        """Standardisation of the vectors that some columns are the components of; arguments as `standardize_values`."""
        mean, variance = self.mean[columns], self.variance[columns]
        scale = variance.mean()
        scale = torch.where(scale > 0, scale.sqrt(), 1.0)
        return Standardization(mean if center else torch.zeros_like(mean), scale.expand(len(mean)).clone())


def standardize_features(samples: Iterable[Features], center_vectors: bool = True) -> Standardization:
    """Standardisation of features over a training split, as `Features.flat` orders them.

    The constant stays as it is; the components of a vector share one scale, so that directions are kept.

    Args:
        samples: Features of each frame, seen once, one at a time.
        center_vectors: Whether the mean of vectors is subtracted; False for rotation-equivariant networks.
    """
    moments, seen = Moments(), None
    for seen in samples:
        moments.add(seen.flat())
    assert seen is not None, "a training split has frames"
    scalars, dim = len(seen.scalar_names), seen.vectors.shape[2]
    parts = []
    for place, name in enumerate(seen.scalar_names):
        one = Standardization(torch.zeros(1, dtype=torch.float64), torch.ones(1, dtype=torch.float64))
        parts.append(one if name == CONSTANT else moments.standardization(slice(place, place + 1)))
    for first in range(scalars, scalars + dim * seen.kinds.vectors, dim):
        parts.append(moments.standardization(slice(first, first + dim), center_vectors))
    return Standardization(torch.cat([part.mean for part in parts]), torch.cat([part.scale for part in parts]))


def standardize_values(frames: Iterable[Float[Tensor, "N C"]], center: bool = True) -> Standardization:
    """Standardisation of vectors (N, C): mean of each component, one scale for all.

    The scale is the root of the mean variance of the components, so that the mean squared error of standardised values
    is the mean squared error divided by the variance. A constant field keeps scale 1.

    Args:
        frames: Tensors (N, C), one a frame, seen once, one at a time.
        center: Whether the mean is subtracted; False for rotation-equivariant networks.
    """
    moments = Moments()
    for values in frames:
        moments.add(values)
    return moments.standardization(center=center)


def unknown(kinds: Kinds, dim: int) -> Standardization:
    """Make a placeholder for the standardisation of so many scalars and vectors."""
    return Standardization(torch.empty(kinds.num_values(dim)), torch.empty(kinds.num_values(dim)))
