"""Losses by name: the mean squared error of standardised targets, and how much each frame counts."""

from collections.abc import Callable

import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

SMALLEST = 1e-3  # root mean square of a frame's standardised target from which on it counts no more

FrameWeight = Callable[[Tensor], float]


def equal(target: Float[Tensor, "M C"]) -> float:
    """Every frame counts alike."""
    return 1.0


def balanced(target: Float[Tensor, "M C"]) -> float:
    """A frame counts by 1 ÷ the root mean square of its standardised target (M, C).

    Frames of a flow that has decayed then still matter beside the fast ones at its start: with equal weights, a model
    that was trained on decaying flows leaves their late frames, in which its own noise is larger than the motion.
    """
    return 1.0 / max(SMALLEST, float(target.detach().square().mean().sqrt()))


LOSSES: dict[str, FrameWeight] = {"mse": equal, "balanced_mse": balanced}


def loss_of(prediction: Float[Tensor, "M C"], target: Float[Tensor, "M C"], weight: FrameWeight) -> Float[Tensor, ""]:
    """Weighted mean squared error of a frame's standardised prediction (M, C)."""
    return weight(target) * F.mse_loss(prediction, target)
