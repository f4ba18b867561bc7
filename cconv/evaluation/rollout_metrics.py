"""Metrics of a rollout frame by frame: positions, kinetic energy, momentum and speeds."""

import torch
from torch import Tensor

from cconv.domain import Box
from cconv.errors import ShapeError


def squared_errors(positions: Tensor, reference: Tensor, box: Box) -> Tensor:
    r"""Mean squared error of positions at each frame, over particles and components, (T,), float64.

    Source: LagrangeBench (Toshev et al., 2023), `mse`: differences are minimum-image displacements.

    Args:
        positions: Rollout (T, N, D).
        reference: Stored frames (T, N, D).
        box: Their box.
    """
    return box.displacement(positions.double(), reference.double()).square().mean(dim=(1, 2))


def mse_n(errors: Tensor, n: int) -> float:
    """MSE_n of LagrangeBench: the mean over the first `n` frames of the errors (T,) of `squared_errors`.

    Raises:
        ShapeError: If the rollout has fewer frames.
    """
    if len(errors) < n:
        raise ShapeError(f"MSE_{n} needs {n} frames of a rollout, got {len(errors)}.")
    return float(errors[:n].mean())


def kinetic_energies(positions: Tensor, box: Box, particle_spacing: float, frame_dt: float) -> Tensor:
    r"""Kinetic energy between each two frames, (T - 1,), float64.

    .. math:: E = dx^D \sum_i |v_i|^2, \qquad v_i = (x_i^{k+1} - x_i^k) / \Delta t

    Source: LagrangeBench (Toshev et al., 2023), `e_kin`, without the factor 1/2.

    Args:
        positions: Frames (T, N, D).
        box: Their box.
        particle_spacing: dx.
        frame_dt: Time between frames.
    """
    velocities = _displacements(positions, box) / frame_dt
    return particle_spacing**box.dim * velocities.square().sum(dim=(1, 2))


def momentum_drift(positions: Tensor, masses: Tensor, box: Box) -> Tensor:
    r"""Change of the momentum since the start ÷ sum of the initial magnitudes, (T - 1,), float64.

    .. math:: \Big|\sum_i m_i (v_i^k - v_i^0)\Big| \Big/ \sum_i m_i |v_i^0|

    Args:
        positions: Frames (T, N, D).
        masses: (N,).
        box: Their box.
    """
    weighted = masses.double()[:, None] * _displacements(positions, box)
    scale = weighted[0].norm(dim=1).sum().clamp(min=torch.finfo(torch.float64).tiny)
    return (weighted - weighted[0]).sum(dim=1).norm(dim=1) / scale


def speeds(positions: Tensor, box: Box, frame_dt: float) -> Tensor:
    """Speeds of the particles between each two of the frames (T, N, D), (T - 1, N), float64, length per time."""
    return _displacements(positions, box).norm(dim=2) / frame_dt


def _displacements(positions: Tensor, box: Box) -> Tensor:
    """Displacements from frame to frame, (T - 1, N, D)."""
    return box.displacement(positions[1:].double(), positions[:-1].double())
