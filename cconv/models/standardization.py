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


def standardize_features(samples: Iterable[Features], center_vectors: bool = True) -> Standardization:
    """Standardisation of features over a training split, as `Features.flat` orders them.

    The constant stays as it is; the components of a vector share one scale, so that directions are kept.

    Args:
        samples: Features of each frame.
        center_vectors: Whether the mean of vectors is subtracted; False for rotation-equivariant networks.
    """
    frames = list(samples)
    parts = []
    for place, name in enumerate(frames[0].scalar_names):
        one = Standardization(torch.zeros(1, dtype=torch.float64), torch.ones(1, dtype=torch.float64))
        parts.append(one if name == CONSTANT else standardize_values(each.scalars[:, [place]] for each in frames))
    for place in range(frames[0].kinds.vectors):
        parts.append(standardize_values((each.vectors[:, place] for each in frames), center_vectors))
    return Standardization(torch.cat([part.mean for part in parts]), torch.cat([part.scale for part in parts]))


def standardize_values(frames: Iterable[Float[Tensor, "N C"]], center: bool = True) -> Standardization:
    """Standardisation of vectors (N, C): mean of each component, one scale for all.

    The scale is the root of the mean variance of the components, so that the mean squared error of standardised values
    is the mean squared error divided by the variance. A constant field keeps scale 1.

    Args:
        frames: Tensors (N, C), one a frame.
        center: Whether the mean is subtracted; False for rotation-equivariant networks.
    """
    stacked = torch.cat([values.double() for values in frames])
    variance = stacked.var(dim=0, correction=0).mean()
    scale = torch.where(variance > 0, variance.sqrt(), 1.0)
    mean = stacked.mean(dim=0) if center else torch.zeros_like(stacked[0])
    return Standardization(mean, scale.expand(stacked.shape[1]).clone())


def unknown(kinds: Kinds, dim: int) -> Standardization:
    """Make a placeholder for the standardisation of so many scalars and vectors."""
    return Standardization(torch.empty(kinds.num_values(dim)), torch.empty(kinds.num_values(dim)))
