"""Averages of weights over the updates of a training, which vary less than the weights of any one update."""

from copy import deepcopy

import torch

from cconv.models.model import Model


def begin_average(model: Model) -> Model:
    """Return a copy of a model, whose weights are to become averages."""
    return deepcopy(model).requires_grad_(False)


@torch.no_grad()
def update_average(average: Model, model: Model, decay: float, updates: int) -> None:
    r"""Take the weights of a model into an exponential moving average of them.

    .. math:: \bar w \leftarrow d\, \bar w + (1 - d)\, w, \qquad d = \min(\text{decay}, (1 + u) / (10 + u))

    Early averages forget faster, so that the initial weights do not last. Source: Polyak and Juditsky, "Acceleration of
    stochastic approximation by averaging" (SIAM J. Control Optim., 1992), in its exponential form.

    Args:
        average: The averages, changed in place.
        model: The model after an update.
        decay: Decay d of the average in an update, in [0, 1).
        updates: Updates u done.
    """
    share = 1.0 - min(decay, (1 + updates) / (10 + updates))
    for kept, latest in zip(average.parameters(), model.parameters(), strict=True):
        kept.lerp_(latest, share)
