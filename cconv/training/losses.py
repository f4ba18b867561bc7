"""Losses by name: the error of a frame's standardised prediction, and how much frames and particles count."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import torch
import torch.nn.functional as F
from jaxtyping import Float, Int
from torch import Tensor

from cconv.errors import check_choice

SMALLEST = 1e-3  # root mean square of a frame's standardised target from which on it counts no more
USUAL_NEIGHBORS = 40.0  # of a particle inside the fluid in three dimensions
SMALLEST_SQUARE = 1e-9  # that is added to a squared error, whose root would have no derivative at 0

FrameWeight = Callable[[Tensor], float]


class Loss(Protocol):
    """Tells how far a frame's answers are off."""

    def __call__(
        self, prediction: Float[Tensor, "M C"], target: Float[Tensor, "M C"], neighbors: Int[Tensor, " M"]
    ) -> Float[Tensor, ""]:
        """Loss of a frame.

        Args:
            prediction: Standardised prediction (M, C).
            target: Standardised target (M, C).
            neighbors: Number of neighbours of each particle in the network, itself not counted, (M,).
        """


def equal(target: Float[Tensor, "M C"]) -> float:
    """Every frame counts alike."""
    return 1.0


def balanced(target: Float[Tensor, "M C"]) -> float:
    """A frame counts by 1 ÷ the root mean square of its standardised target (M, C).

    Frames of a flow that has decayed then still matter beside the fast ones at its start: with equal weights, a model
    that was trained on decaying flows leaves their late frames, in which its own noise is larger than the motion.
    """
    return 1.0 / max(SMALLEST, float(target.detach().square().mean().sqrt()))


@dataclass(frozen=True)
class SquaredError:
    """Mean squared error of a frame times its weight.

    Attributes:
        weight: How much a frame counts, by its own target.
    """

    weight: FrameWeight

    def __call__(self, prediction: Tensor, target: Tensor, neighbors: Tensor) -> Tensor:
        """Loss of a frame; arguments as of `Loss`."""
        return self.weight(target) * F.mse_loss(prediction, target)


def neighbor_weighted(
    prediction: Float[Tensor, "M C"], target: Float[Tensor, "M C"], neighbors: Int[Tensor, " M"]
) -> Float[Tensor, ""]:
    r"""Mean root of the distance between answers and targets, in which particles with few neighbours count more.

    .. math:: \frac{1}{M} \sum_i e^{-N_i / 40} \sqrt{|\hat a_i - a_i|}

    Splashes and surfaces, where the fluid is seen, then matter beside the many particles inside. Source: Ummenhofer et
    al., "Lagrangian Fluid Simulation with Continuous Convolutions" (ICLR 2020), section 4, equation 10.
    """
    distances = ((prediction - target).square().sum(dim=1) + SMALLEST_SQUARE).sqrt()
    return (torch.exp(-neighbors / USUAL_NEIGHBORS) * distances.sqrt()).mean()


SQUARED = {"mse": SquaredError(equal), "balanced_mse": SquaredError(balanced)}
LOSSES: dict[str, Loss] = {**SQUARED, "neighbor_weighted": neighbor_weighted}


def frame_weight(name: str) -> FrameWeight:
    """How much a frame counts in a least-squares fit by a loss of some name.

    Raises:
        ConfigError: If the loss is not a sum of squares.
    """
    check_choice("training.loss", name, SQUARED)
    return SQUARED[name].weight
