"""All metrics of a rollout beside the stored frames, as series that can be written as JSON."""

from dataclasses import asdict, dataclass

import numpy as np
from scipy.stats import wasserstein_distance
from torch import Tensor

from cconv.data.trajectory import Scene
from cconv.errors import ConfigError, DataError, check_shape
from cconv.evaluation.particle_distribution import (
    FREE_SURFACE,
    MOST_POINTS,
    chamfer_distance,
    density_error,
    dirichlet_energy,
    neighbor_histogram,
    sinkhorn_divergence,
    speed_histogram,
    surroundings,
)
from cconv.evaluation.rollout_metrics import kinetic_energies, momentum_drift, speeds, squared_errors

SPEED_BINS = 32


@dataclass(frozen=True, kw_only=True)
class FlowMetrics:
    """Measures of the fluid along one path, at F frames of it.

    Attributes:
        e_kin: Kinetic energy without the factor 1/2, from the frame before, (F,); see `kinetic_energies`.
        momentum_drift: Change of the momentum since the first step ÷ sum of the magnitudes there, (F,).
        rho_mae: Mean |ρ - 1| of the density ÷ rest density, ρ below 0.98 counted as 1, (F,).
        rho_mae_unclamped: Mean |ρ - 1| as it is, (F,).
        rho_min: Smallest ρ, (F,).
        rho_max: Largest ρ, (F,).
        dirichlet: Dirichlet energy of ρ, (F,).
        neighbors: Shares of particles with 0, 1, ... neighbours, the last with 31 or more, (F, 32).
        speeds: Shares of particles with speeds in each bin, (F, bins).
    """

    e_kin: np.ndarray
    momentum_drift: np.ndarray
    rho_mae: np.ndarray
    rho_mae_unclamped: np.ndarray
    rho_min: np.ndarray
    rho_max: np.ndarray
    dirichlet: np.ndarray
    neighbors: np.ndarray
    speeds: np.ndarray


@dataclass(frozen=True, kw_only=True)
class RolloutMetrics:
    """Metrics of a rollout of T frames after its start, most of them at F of these frames.

    Attributes:
        frames: Numbers of these frames, counted from the start, which is 0, (F,).
        mse: Mean squared error of positions in each of the T frames, (T,); `mse_n` has their mean.
        e_kin_mse: Squared differences of the kinetic energies, (F,); LagrangeBench gives their mean.
        chamfer: Chamfer distances to the stored frames, (F,).
        sinkhorn_frames: Numbers of the frames with a Sinkhorn divergence, (S,).
        sinkhorn: Sinkhorn divergences, (S,).
        neighbors_distance: Total variation distance of the histograms of neighbours, 0 to 1, (F,).
        speeds_distance: Wasserstein-1 distance of the speeds, length per time, (F,).
        speed_edges: Edges of the bins of speeds, from 0 to the largest stored speed; the last bin has faster ones, too.
        rollout: Measures of the rollout itself.
        reference: The same of the stored frames.
    """

    frames: np.ndarray
    mse: np.ndarray
    e_kin_mse: np.ndarray
    chamfer: np.ndarray
    sinkhorn_frames: np.ndarray
    sinkhorn: np.ndarray
    neighbors_distance: np.ndarray
    speeds_distance: np.ndarray
    speed_edges: np.ndarray
    rollout: FlowMetrics
    reference: FlowMetrics

    def as_dict(self) -> dict:
        """Numbers and lists under the names of the attributes, for JSON."""
        return _plain(asdict(self))


def check_masses(masses: Tensor, is_fluid: Tensor) -> None:
    """Check that the fluid has a mass, so that densities relative to that of rest are defined.

    Raises:
        DataError: If it has none.
    """
    mean = float(masses[is_fluid].double().mean())
    if not mean > 0:
        raise DataError(
            f"the mean mass of the fluid must be positive, got {mean:g}; correct the masses or give --mass."
        )


def rollout_metrics(
    positions: Tensor,
    reference: Tensor,
    masses: Tensor,
    is_fluid: Tensor,
    scene: Scene,
    *,
    stride: int = 10,
    sinkhorn_stride: int = 1,
    most_points: int = MOST_POINTS,
) -> RolloutMetrics:
    """All metrics of a rollout beside the stored frames, every few frames.

    The squared error is that of all particles, as in LagrangeBench. All others are of the fluid alone, also where
    LagrangeBench and Neural SPH average over all particles, because walls, whose positions are prescribed, would dilute
    them. In sums for densities and as neighbours all particles count.

    Args:
        positions: The frame that the rollout began with and the T that it predicted, (T + 1, N, D).
        reference: The stored frames of the same times, (T + 1, N, D).
        masses: (N,).
        is_fluid: Which particles are fluid, (N,), bool.
        scene: Their scene.
        stride: Frames from one that is looked at to the next; the squared errors are of every frame.
        sinkhorn_stride: Of the frames that are looked at, every so many-th has a Sinkhorn divergence, which takes
            most of the time.
        most_points: Limit of `sinkhorn_divergence`.

    Raises:
        ShapeError: If shapes do not fit.
        ConfigError: If a stride is less than 1, or there are fewer frames.
        DataError: If the fluid has no mass.
    """
    check_shape("positions", positions.shape, ("frames", len(masses), scene.dim))
    check_shape("reference", reference.shape, tuple(positions.shape))
    if not 1 <= stride < len(positions):
        raise ConfigError(f"`stride` must be from 1 to the {len(positions) - 1} frames of the rollout, got {stride}.")
    if sinkhorn_stride < 1:
        raise ConfigError(f"`sinkhorn_stride` must be at least 1, got {sinkhorn_stride}.")
    frames = np.arange(stride, len(positions), stride)
    check_masses(masses, is_fluid)
    both = positions.double(), reference.double()
    fluid = [path[:, is_fluid] for path in both]
    moving = [speeds(path, scene.box, scene.frame_dt)[frames - 1].numpy() for path in fluid]
    edges = np.linspace(0, float(moving[1].max()) or 1.0, SPEED_BINS + 1)
    found, stored = (
        _flow_metrics(path, masses.double(), is_fluid, scene, frames, [speed_histogram(each, edges) for each in paces])
        for path, paces in zip(both, moving, strict=True)
    )
    pairs = {int(frame): (fluid[0][frame], fluid[1][frame], scene.box) for frame in frames}
    transported = frames[::sinkhorn_stride]
    return RolloutMetrics(
        frames=frames,
        mse=squared_errors(*both, scene.box)[1:].numpy(),
        e_kin_mse=np.square(found.e_kin - stored.e_kin),
        chamfer=np.array([chamfer_distance(*pair) for pair in pairs.values()]),
        sinkhorn_frames=transported,
        sinkhorn=np.array([sinkhorn_divergence(*pairs[frame], most_points=most_points) for frame in transported]),
        neighbors_distance=np.abs(found.neighbors - stored.neighbors).sum(axis=1) / 2,
        speeds_distance=np.array([wasserstein_distance(*each) for each in zip(*moving, strict=True)]),
        speed_edges=edges,
        rollout=found,
        reference=stored,
    )


def _flow_metrics(
    path: Tensor, masses: Tensor, is_fluid: Tensor, scene: Scene, frames: np.ndarray, histograms: list[np.ndarray]
) -> FlowMetrics:
    """Measures of a path (T + 1, N, D) at some frames, with the histograms of speeds there."""
    spacing, fluid = scene.particle_spacing, path[:, is_fluid]
    volumes = masses / masses[is_fluid].mean() * spacing**scene.dim
    around = [surroundings(path[frame], volumes, scene.box, spacing).of(is_fluid) for frame in frames]
    return FlowMetrics(
        e_kin=kinetic_energies(fluid, scene.box, spacing, scene.frame_dt)[frames - 1].numpy(),
        momentum_drift=momentum_drift(fluid, masses[is_fluid], scene.box)[frames - 1].numpy(),
        rho_mae=np.array([density_error(each.densities, FREE_SURFACE) for each in around]),
        rho_mae_unclamped=np.array([density_error(each.densities) for each in around]),
        rho_min=np.array([float(each.densities.min()) for each in around]),
        rho_max=np.array([float(each.densities.max()) for each in around]),
        dirichlet=np.array([dirichlet_energy(each.gradients, spacing) for each in around]),
        neighbors=np.stack([neighbor_histogram(each.neighbors) for each in around]),
        speeds=np.stack(histograms),
    )


def _plain(values: dict) -> dict:
    return {name: _plain(value) if isinstance(value, dict) else value.tolist() for name, value in values.items()}
