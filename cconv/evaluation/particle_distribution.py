"""How particles are distributed: the distance of two sets of points, and what surrounds each particle of a frame."""

import math
from typing import NamedTuple

import numpy as np
import torch
from scipy.spatial import KDTree
from torch import Tensor

from cconv.domain import Box
from cconv.errors import check_shape
from cconv.neighbors import from_corner, radius_graph
from cconv.sph.kernels import QuinticSpline
from cconv.sph.operators import density, kernel_gradient

RELATIVE_EPSILON = 0.05  # ε of the Sinkhorn divergence ÷ mean cost
MARGINAL_ERROR = 1e-4  # at which Sinkhorn iterations stop, in L1
MOST_ITERATIONS = 2000
LARGEST_EXPONENT = 700.0  # cost ÷ ε below which exp(-cost/ε) is no zero in float64
MOST_POINTS = 10_000  # points of a Sinkhorn divergence, above which a part of them stands for all

FREE_SURFACE = 0.98  # density ÷ rest density below which the clamped error takes a particle for one at a free surface
NEIGHBOR_RADIUS = 1.45  # particle spacings within which neighbours are counted; LagrangeBench's connectivity radius
MOST_NEIGHBORS = 31  # of the histogram; its last bin has all particles with as many or more


def sinkhorn_divergence(
    points: Tensor,
    reference: Tensor,
    box: Box,
    *,
    relative_epsilon: float = RELATIVE_EPSILON,
    most_points: int = MOST_POINTS,
    seed: int = 0,
) -> float:
    r"""Sinkhorn divergence of two sets of points with equal weights, length².

    .. math:: S = OT_\epsilon(x, y) - \tfrac12 OT_\epsilon(x, x) - \tfrac12 OT_\epsilon(y, y), \qquad
        OT_\epsilon(x, y) = \min_P \sum_{ij} P_{ij} c_{ij} + \epsilon\, KL(P \,|\, a \otimes b)

    with c the squared minimum-image distance, and one :math:`\epsilon` = `relative_epsilon` · mean of c(x, y) for all
    three terms, each the dual value by POT's Sinkhorn iterations in float64.

    Source: Feydy et al., "Interpolating between optimal transport and MMD using Sinkhorn divergences", AISTATS (2019).
    LagrangeBench (Toshev et al., 2023) computes the same with OTT 0.4, whose default :math:`\epsilon` this is, but in
    float32, which leaves rounding errors of about 1e-8 in a box of length 1. Its option "pot" has
    :math:`\epsilon = 0.1` length² and leaves out the entropy, which are other numbers.

    Time and memory grow with N²: about 3 and 14 s on a core, and 50 N² bytes, for 2,500 and 5,000 points.

    Args:
        points: x, (N, D).
        reference: y, (N, D).
        box: Their box.
        relative_epsilon: ε ÷ mean cost.
        most_points: Above this N, the same random particles of both sets stand for all. Where both sets are equally
            well distributed but particles have moved far, as in long rollouts of periodic flows, the result is then the
            noise of the choice: 3e-5 instead of 2e-9 for 1,000 of the 2,500 particles of LagrangeBench's 2D TGV.
        seed: Seed of their choice.

    Raises:
        ShapeError: If the sets differ in shape.
    """
    check_shape("reference", reference.shape, tuple(points.shape))
    if len(points) > most_points:
        chosen = torch.randperm(len(points), generator=torch.Generator().manual_seed(seed))[:most_points]
        points, reference = points[chosen], reference[chosen]
    costs = _squared_distances(points, reference, box)
    epsilon = relative_epsilon * float(costs.mean())
    if epsilon == 0:  # all are at one place
        return 0.0
    between = _transport_cost(costs, epsilon)
    within = [_transport_cost(_squared_distances(each, each, box), epsilon) for each in (points, reference)]
    return max(0.0, between - sum(within) / 2)


def chamfer_distance(points: Tensor, reference: Tensor, box: Box) -> float:
    r"""Chamfer distance of two sets of points: mean distance to the nearest point of the other set, there plus back.

    .. math:: \frac1N \sum_i \min_j |x_i - y_j| + \frac1M \sum_j \min_i |x_i - y_j|

    Source: Neural SPH (Toshev et al., 2024), its code; the text of the paper squares the distances. Distances here are
    those of the minimum image, in its code those of open space.

    Args:
        points: x, (N, D).
        reference: y, (M, D).
        box: Their box.
    """
    lengths = np.where(box.periodic, box.lengths, 0.0)  # 0 is scipy's open axis
    x, y = (from_corner(each.detach().cpu().double(), box).numpy() for each in (points, reference))
    there, _ = KDTree(y, boxsize=lengths).query(x)
    back, _ = KDTree(x, boxsize=lengths).query(y)
    return float(there.mean() + back.mean())


class Surroundings(NamedTuple):
    """What surrounds each of N particles.

    Attributes:
        densities: Density ÷ rest density, (N,), float64.
        gradients: Gradient of that sum with respect to the position of the particle, (N, D), 1/length.
        neighbors: Number of others within `NEIGHBOR_RADIUS`, (N,), int64.
    """

    densities: Tensor
    gradients: Tensor
    neighbors: Tensor

    def of(self, particles: Tensor) -> "Surroundings":
        """Those of some particles, by indices or truth values."""
        return Surroundings(*(each[particles] for each in self))


def surroundings(positions: Tensor, volumes: Tensor, box: Box, particle_spacing: float) -> Surroundings:
    r"""Densities, their gradients and numbers of neighbours, by sums over all particles of a frame, walls included.

    .. math:: \rho_i / \rho_0 = \sum_j V_j W(|x_i - x_j|), \qquad \nabla \rho_i / \rho_0 = \sum_j V_j \nabla_i W_{ij}

    with the quintic spline of smoothing length dx. Wall points that are no particles are not seen.

    Source: Neural SPH (Toshev et al., 2024), whose V is dx^D.

    Args:
        positions: (N, D).
        volumes: V, mass ÷ rest density, (N,).
        box: Their box.
        particle_spacing: dx.
    """
    kernel = QuinticSpline(particle_spacing, box.dim)
    volumes = volumes.double()
    edges = radius_graph(positions.double(), kernel.support_radius, box)
    terms = volumes[edges.senders, None] * kernel_gradient(edges, kernel)
    near = edges.distances <= NEIGHBOR_RADIUS * particle_spacing
    return Surroundings(
        densities=density(volumes, edges, kernel),
        gradients=terms.new_zeros(positions.shape).index_add(0, edges.receivers, terms),
        neighbors=torch.bincount(edges.receivers[near], minlength=len(positions)),
    )


def density_error(densities: Tensor, free_surface: float = 0.0) -> float:
    """Mean |ρ - 1| of relative densities (N,), where ρ below `free_surface` counts as 1.

    With `FREE_SURFACE` this is the `rho_mae` of Neural SPH (Toshev et al., 2024), which sees compression alone: neither
    voids nor the rims of a fluid count. With 0 all deviations count.
    """
    return float(torch.where(densities < free_surface, 1.0, densities).sub(1).abs().mean())


def dirichlet_energy(gradients: Tensor, particle_spacing: float) -> float:
    r"""Dirichlet energy of the density, :math:`\tfrac12 dx^D \sum_i |\nabla \rho_i|^2`, length^(D-2).

    It is 0 on a lattice without boundary, and large where particles clump or leave voids.

    Source: Neural SPH (Toshev et al., 2024).

    Args:
        gradients: ∇ρ of relative densities, (N, D).
        particle_spacing: dx.
    """
    return 0.5 * particle_spacing ** gradients.shape[1] * float(gradients.square().sum())


def neighbor_histogram(neighbors: Tensor) -> np.ndarray:
    """Shares of particles with 0, 1, ... neighbours, the last `MOST_NEIGHBORS` or more, from their numbers (N,)."""
    counts = np.bincount(neighbors.clamp(max=MOST_NEIGHBORS).numpy(), minlength=MOST_NEIGHBORS + 1)
    return counts / len(neighbors)


def speed_histogram(speeds: np.ndarray, edges: np.ndarray) -> np.ndarray:
    """Shares of particles with speeds (N,) between each two of the edges (B + 1,); faster ones are in the last bin."""
    return np.histogram(speeds.clip(max=edges[-1]), bins=edges)[0] / len(speeds)


def _squared_distances(points: Tensor, reference: Tensor, box: Box) -> Tensor:
    """Squared minimum-image distances (N, M), float64; axis by axis, as the memory is that of a few such tables."""
    x, y = (box.wrap(each.detach().double()) for each in (points, reference))
    total = x.new_zeros(len(x), len(y))
    for axis, (length, periodic) in enumerate(zip(box.lengths, box.periodic, strict=True)):
        along = (x[:, None, axis] - y[None, :, axis]).abs_()
        if periodic:
            torch.minimum(along, length - along, out=along)
        total += along.square_()
    return total


def _transport_cost(costs: Tensor, epsilon: float) -> float:
    """Entropic cost OT_ε of equal weights (N, N): its dual value, whose error is quadratic in that of the marginals."""
    import ot  # takes seconds

    n = len(costs)
    weights = costs.new_full((n,), 1 / n)
    options = {"stopThr": MARGINAL_ERROR / math.sqrt(n), "numItermax": MOST_ITERATIONS, "log": True, "warn": True}
    if float(costs.max()) < LARGEST_EXPONENT * epsilon:
        _, found = ot.bregman.sinkhorn_knopp(weights, weights, costs, epsilon, **options)
        logarithms = found["u"].log() + found["v"].log()
    else:  # some fifty times slower
        _, found = ot.bregman.sinkhorn_log(weights, weights, costs, epsilon, **options)
        logarithms = found["log_u"] + found["log_v"]
    return epsilon * (float(logarithms.mean()) + 2 * math.log(n))
