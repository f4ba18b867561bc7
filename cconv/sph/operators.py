r"""SPH sums over neighbours: density D1, its rate D2, its gradient D3, the gradient of velocities, and interpolation.

Numbers are those of the thesis, section 2.2.1; i is ``edges.receivers``, j is ``edges.senders``, and
:math:`\nabla_i W_{ij} = W'(r_{ij})\, r_{ij} / |r_{ij}|` with :math:`r_{ij} = x_i - x_j` = ``edges.displacements``.
"""

import torch
from jaxtyping import Float
from torch import Tensor

from cconv.errors import ConfigError, check_shape
from cconv.neighbors import Edges
from cconv.sph.kernels import AbstractKernel


def density(masses: Float[Tensor, " M"], edges: Edges, kernel: AbstractKernel) -> Float[Tensor, " N"]:
    r"""Density by summation (D1), the particle itself included.

    .. math:: \rho_i = \sum_j m_j W(|r_{ij}|, h)

    Receivers of bipartite edges are points without mass of their own.

    Args:
        masses: m of the senders (M,).
        edges: Pairs within at least the kernel's support.
        kernel: W.

    Returns:
        ρ of the receivers (N,), mass/length^D.

    Raises:
        ShapeError: If `masses` does not fit the edges.
        ConfigError: If the edges do not reach as far as the kernel, or differ from it in dimension.
    """
    check_sum(edges, kernel, masses=(masses, (edges.num_senders,)))
    rho = sum_over_neighbors(masses[edges.senders] * kernel.value(edges.distances), edges)
    if edges.bipartite or edges.includes_self:
        return rho
    return rho + masses * kernel.value(masses.new_zeros(()))


def density_rate(
    masses: Float[Tensor, " N"], velocities: Float[Tensor, "N D"], edges: Edges, kernel: AbstractKernel
) -> Float[Tensor, " N"]:
    r"""Material rate of density (D2), exactly d/dt of D1 along the particles' motion.

    .. math:: \frac{D\rho_i}{Dt} = \sum_j m_j (v_i - v_j) \cdot \nabla_i W_{ij}

    Args:
        masses: m (N,).
        velocities: v (N, D), length/time.
        edges: Pairs of the particles within at least the kernel's support.
        kernel: W.

    Returns:
        Dρ/Dt (N,), mass/(length^D time).

    Raises:
        ShapeError: If shapes do not fit the edges.
        ConfigError: If the edges are bipartite, do not reach as far as the kernel, or differ from it in dimension.
    """
    check_one_set(edges)
    particles = edges.num_senders
    check_sum(edges, kernel, masses=(masses, (particles,)), velocities=(velocities, (particles, edges.dim)))
    difference = velocities[edges.receivers] - velocities[edges.senders]
    terms = masses[edges.senders] * (difference * kernel_gradient(edges, kernel)).sum(dim=1)
    return sum_over_neighbors(terms, edges)


def density_gradient(
    masses: Float[Tensor, " N"], densities: Float[Tensor, " N"], edges: Edges, kernel: AbstractKernel
) -> Float[Tensor, "N D"]:
    r"""Gradient of density (D3), with the sign that converges to ∇ρ.

    .. math:: \nabla \rho_i = \frac{1}{\rho_i} \sum_j m_j (\rho_j - \rho_i) \nabla_i W_{ij}

    The printed form of the thesis has :math:`(\rho_i - \rho_j)`; with :math:`\nabla_i` the derivative with respect to
    :math:`x_i` it gives :math:`-\nabla\rho`.

    Args:
        masses: m (N,).
        densities: ρ (N,), e.g. from `density`.
        edges: Pairs of the particles within at least the kernel's support.
        kernel: W.

    Returns:
        ∇ρ (N, D), mass/length^(D+1).

    Raises:
        ShapeError: If shapes do not fit the edges.
        ConfigError: If the edges are bipartite, do not reach as far as the kernel, or differ from it in dimension.
    """
    check_one_set(edges)
    particles = edges.num_senders
    check_sum(edges, kernel, masses=(masses, (particles,)), densities=(densities, (particles,)))
    difference = densities[edges.senders] - densities[edges.receivers]
    terms = (masses[edges.senders] * difference)[:, None] * kernel_gradient(edges, kernel)
    return sum_over_neighbors(terms, edges) / densities[:, None]


def velocity_gradient(
    volumes: Float[Tensor, " N"], velocities: Float[Tensor, "N D"], edges: Edges, kernel: AbstractKernel
) -> Float[Tensor, "N D D"]:
    r"""Gradient of the velocity, :math:`(\nabla v)_{ab} = \partial v_a / \partial x_b`.

    .. math:: (\nabla v)_i = \sum_j V_j (v_j - v_i) \otimes \nabla_i W_{ij}

    Rotations and shears of a regular arrangement are right to the accuracy of the sum over its kernel; a uniform motion
    has none. Source: Monaghan, "Smoothed particle hydrodynamics" (Rep. Prog. Phys., 2005), section 2.2.

    Args:
        volumes: V = m/ρ (N,).
        velocities: v (N, D), length/time.
        edges: Pairs of the particles within at least the kernel's support.
        kernel: W.

    Returns:
        (N, D, D), 1/time.

    Raises:
        ShapeError: If shapes do not fit the edges.
        ConfigError: If the edges are bipartite, do not reach as far as the kernel, or differ from it in dimension.
    """
    check_one_set(edges)
    particles = edges.num_senders
    check_sum(edges, kernel, volumes=(volumes, (particles,)), velocities=(velocities, (particles, edges.dim)))
    difference = volumes[edges.senders, None] * (velocities[edges.senders] - velocities[edges.receivers])
    return sum_over_neighbors(difference[:, :, None] * kernel_gradient(edges, kernel)[:, None, :], edges)


def interpolate(
    values: Float[Tensor, "M C"], volumes: Float[Tensor, " M"], edges: Edges, kernel: AbstractKernel
) -> Float[Tensor, "N C"]:
    r"""Interpolate values of particles, normalised by Shepard so that constants are reproduced.

    .. math:: A(x_i) = \sum_j V_j A_j W_{ij} \Big/ \sum_j V_j W_{ij}

    Linear fields are off by a part of the particle spacing times their slope. A receiver without a neighbour gets NaN.

    Args:
        values: A of the senders (M, C).
        volumes: V = m/ρ of the senders (M,).
        edges: Pairs within at least the kernel's support; usually bipartite.
        kernel: W.

    Raises:
        ShapeError: If shapes do not fit the edges.
        ConfigError: If the edges do not reach as far as the kernel, or differ from it in dimension.
    """
    senders = edges.num_senders
    check_sum(edges, kernel, volumes=(volumes, (senders,)), values=(values, (senders, "components")))
    weights = volumes[edges.senders] * kernel.value(edges.distances)
    return (
        sum_over_neighbors(weights[:, None] * values[edges.senders], edges)
        / sum_over_neighbors(weights, edges)[:, None]
    )


def kernel_gradient(edges: Edges, kernel: AbstractKernel) -> Float[Tensor, "E D"]:
    """∇_i W_ij of every edge (E, D); zero where two particles coincide."""
    apart = edges.distances > 0
    direction = edges.displacements / torch.where(apart, edges.distances, 1.0)[:, None]
    return kernel.derivative(edges.distances)[:, None] * direction


def sum_over_neighbors(terms: Tensor, edges: Edges) -> Tensor:
    """Sums (N, ...) of the terms (E, ...) of each receiver's pairs."""
    return terms.new_zeros(edges.num_receivers, *terms.shape[1:]).index_add(0, edges.receivers, terms)


def check_sum(edges: Edges, kernel: AbstractKernel, **tensors: tuple[Tensor, tuple[int | str, ...]]) -> None:
    """Raise `ShapeError` or `ConfigError` unless a sum with the kernel can be taken over the edges.

    Args:
        edges: Pairs to sum over.
        kernel: W.
        tensors: What is summed, each with the shape that it must have.
    """
    for name, (tensor, shape) in tensors.items():
        check_shape(name, tensor.shape, shape)
    if edges.dim != kernel.dim:
        raise ConfigError(f"`kernel` must have the dimension of `edges` ({edges.dim}), got {kernel.dim}.")
    if edges.cutoff < kernel.support_radius * (1 - 1e-9):
        raise ConfigError(
            f"`edges` must reach as far as the kernel's support ({kernel.support_radius}), got a cutoff of "
            f"{edges.cutoff}; build them with radius_graph(positions, kernel.support_radius)."
        )


def check_one_set(edges: Edges) -> None:
    """Raise `ConfigError` if the edges join two sets of points."""
    if edges.bipartite:
        raise ConfigError(
            "`edges` must join the particles of one set, got bipartite edges; build them with "
            "radius_graph(positions, cutoff) without queries."
        )
