"""Quantities of the particles of a frame, for colours, export and checks."""

import torch
from scipy.spatial import cKDTree
from torch import Tensor

from cconv.data.splits import evenly_spaced
from cconv.data.trajectory import Frame, Scene
from cconv.neighbors import radius_graph
from cconv.sph.compiled import compiled_sums
from cconv.sph.kernels import QuinticSpline

MOST_NEIGHBORS = 2000  # that are counted for a particle; usual are 10 to 60
_PARTICLES_COUNTED = 1000  # for a mean number of neighbours
_BLOCK = 200_000  # particles whose pairs are listed at once: about 1 GB in 3D


def speed(frame: Frame) -> Tensor:
    """Return the magnitude of each particle's velocity (N,), length per time."""
    return torch.linalg.vector_norm(frame.velocities, dim=1)


def density_deviation(frame: Frame, scene: Scene) -> Tensor:
    r"""How far each particle's density is from rest, :math:`\rho_i / \rho_0 - 1`, with :math:`\rho_0 = m_i / dx^D`.

    ρ is the sum D1 over all particles, wall particles included, with a quintic spline of smoothing length dx: a lattice
    of spacing dx deviates by less than 1e-4. Boundary points have no mass and count as empty space, as does what lies
    beyond a free surface.

    Args:
        frame: Particles at one time.
        scene: Spacing and box of the particles.

    Returns:
        Deviations (N,), float64, without unit.

    Raises:
        ConfigError: If the kernel's support, 3 dx, exceeds half of a periodic axis.
    """
    kernel = QuinticSpline(scene.particle_spacing, scene.dim)
    positions, masses = frame.positions.double(), frame.masses.double()
    densities = [
        compiled_sums(kernel).density(masses, radius_graph(positions, kernel.support_radius, scene.box, block))
        for block in positions.split(_BLOCK)
    ]
    return torch.cat(densities) * scene.particle_spacing**scene.dim / masses - 1


def mean_neighbors(positions: Tensor, radius: float) -> float:
    """Mean number of particles (N, D) within a radius of one, itself included; without regard to periodic axes.

    It is that of a thousand particles, evenly spaced in storage, where there are more.
    """
    points = positions.double().numpy()
    asked = points[evenly_spaced(len(points), _PARTICLES_COUNTED)]
    return float(cKDTree(points).query_ball_point(asked, radius, return_length=True).mean())
