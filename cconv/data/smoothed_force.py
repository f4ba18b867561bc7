r"""External forces over the time between two frames, from which particles travel through a force that varies.

A frame spans M steps of a solver. With a constant acceleration g, the second difference of positions a frame apart is
exactly :math:`(M \Delta t)^2 g` after semi-implicit Euler steps. Where the force varies, its mean over the frame takes
the place of g, approximately the force smoothed by a normal distribution of the particles' displacements:

.. math:: g_M^{FD}(x) = (M \Delta t)^2 \, E[g(x + \sigma_u z)], \qquad z \sim N(0, 1)

Source: Toshev et al., "Neural SPH: Improved Neural Modeling of Lagrangian Fluid Dynamics" (ICML 2024), eq. 4 and
appendix F.
"""

import math
from collections.abc import Sequence
from itertools import product

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from cconv.domain import Box
from cconv.errors import ConfigError, ShapeError, check_shape
from cconv.forces import Accelerating, ReversePoiseuilleForce

_FARTHEST = 5.0  # standard deviations; beyond them lies less than 1e-6 of the weight


def evaluated(force: Accelerating, positions: Float[Tensor, "N D"]) -> Float[Tensor, "N D"]:
    """Accelerations (N, D) by a force at some positions, checked.

    Raises:
        ShapeError: If the force does not return one vector for each position.
        ConfigError: If it returns NaN or infinity.
    """
    accelerations = force(positions)
    if not isinstance(accelerations, Tensor):
        raise ShapeError(f"`force` must return a tensor, got a {type(accelerations).__name__}.")
    if accelerations.shape != positions.shape:
        check_shape("force(positions)", accelerations.shape, tuple(positions.shape))
    finite = torch.isfinite(accelerations).all(dim=1)
    if not finite.all():
        place = ", ".join(f"{value:g}" for value in positions[int((~finite).int().argmax())].tolist())
        raise ConfigError(
            f"`force` must be finite, got NaN or infinity for {int((~finite).sum())} of {len(positions)} positions, "
            f"the first at ({place}); correct the function."
        )
    return accelerations


def travel_deviation(velocity_deviations: Sequence[float]) -> float:
    """Standard deviation σ_u by which particles travel in a frame, from that of each component of their velocities.

    It is the root mean square of the components, the same along all axes: that gives the 0.0254 and 0.0427 that
    Neural SPH computes for reverse Poiseuille flow in two and three dimensions (and rounds to 0.025 and 0.05).

    Args:
        velocity_deviations: Standard deviations of the components, length per frame, e.g. ``vel_std`` in the metadata
            of LagrangeBench.

    Returns:
        σ_u, length.
    """
    return math.sqrt(sum(value**2 for value in velocity_deviations) / len(velocity_deviations))


def smoothed(force: Accelerating, deviations: Sequence[float], nodes: int = 64) -> Accelerating:
    r"""The mean of a force over normally distributed displacements around each position.

    The mean is a sum over equally spaced displacements up to five standard deviations, a midpoint rule. With 64 of them
    it is exact to 1e-5 of a force that varies smoothly, and off by at most 3.1 % of a jump in a force that has one.
    (Gauss-Hermite quadrature with as many nodes is off by 7 % of a jump.)

    Args:
        force: Positions (N, D) to accelerations (N, D).
        deviations: Standard deviation σ_u along each axis, length; 0 along axes that the force does not depend on,
            which saves a factor of `nodes` in time.
        nodes: Displacements along an axis.

    Returns:
        The smoothed force, which raises what `evaluated` raises. With deviations of 0 it is the force itself.

    Raises:
        ConfigError: If a deviation is negative or not finite, or there is no node.
    """
    for deviation in deviations:
        if not 0 <= deviation < math.inf:
            raise ConfigError(f"`deviations` must be numbers from 0 on, got {deviation}.")
    if nodes < 1:
        raise ConfigError(f"`nodes` must be at least 1, got {nodes}.")
    rules = [_rule(float(deviation), nodes) for deviation in deviations]

    def mean(positions: Tensor) -> Tensor:
        check_shape("positions", positions.shape, ("particles", len(rules)))
        total = torch.zeros_like(positions)
        for pairs in product(*rules):
            offset = positions.new_tensor([place for place, _ in pairs])
            total += math.prod(weight for _, weight in pairs) * evaluated(force, positions + offset)
        return total

    return mean


def _rule(deviation: float, nodes: int) -> list[tuple[float, float]]:
    """Places and weights of the midpoint rule for a normal distribution; symmetric, and the weights sum to 1."""
    if deviation == 0:
        return [(0.0, 1.0)]
    places = 2 * _FARTHEST * ((np.arange(nodes) + 0.5) / nodes - 0.5)
    weights = np.exp(-(places**2) / 2)
    return list(zip((deviation * places).tolist(), (weights / weights.sum()).tolist(), strict=True))


def smoothed_reverse_poiseuille(box: Box, magnitude: float, deviation: float) -> Accelerating:
    """The smoothed force of reverse Poiseuille flow in a box of any place and height, in closed form.

    Before smoothing the force is along x, g in the lower half and -g in the upper one, as in LagrangeBench's data; see
    `cconv.forces.ReversePoiseuilleForce.smoothed`.

    Args:
        box: Domain, periodic along the second axis, much longer there than the deviation.
        magnitude: g, length/time².
        deviation: σ_u, length.

    Raises:
        ConfigError: If the deviation is not positive or exceeds a tenth of the box, or the second axis is not periodic.
    """
    if box.dim < 2 or not box.periodic[1]:
        raise ConfigError("`box` of a reverse Poiseuille flow must be periodic along its second axis.")
    if not 0 < deviation <= 0.1 * box.lengths[1]:
        raise ConfigError(
            f"`deviation` must be positive and at most a tenth of the box along its second axis ({box.lengths[1]:g}), "
            f"got {deviation:g}."
        )
    force = ReversePoiseuilleForce(magnitude, box.lengths[1]).smoothed(deviation)
    lower = torch.tensor(box.lower)

    def mean(positions: Tensor) -> Tensor:
        check_shape("positions", positions.shape, ("particles", box.dim))
        return force(positions - lower.to(positions))

    return mean
