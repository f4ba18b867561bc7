"""All metrics of a rollout beside the stored frames, as series that can be written as JSON."""

from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass
from typing import Any, NamedTuple

import numpy as np
import torch
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
    meter = RolloutMeter(
        positions[0],
        masses,
        is_fluid,
        scene,
        stride=stride,
        sinkhorn_stride=sinkhorn_stride,
        speed_edges=speed_edges(reference, is_fluid, scene, stride),
        most_points=most_points,
    )
    for frames in zip(positions[1:], reference[1:], strict=True):
        meter.add(*frames)
    return meter.metrics()


def speed_edges(reference: Iterable[Tensor], is_fluid: Tensor, scene: Scene, stride: int) -> np.ndarray:
    """Edges (bins + 1,) of histograms of speeds, from 0 to the largest at the frames that a `RolloutMeter` looks at.

    Args:
        reference: The stored frame that the rollout begins with and those after it, (N, D) each, read once.
        is_fluid: Which particles are fluid, (N,), bool.
        scene: Their scene.
        stride: Frames from one that is looked at to the next.
    """
    largest, before = 0.0, None
    for number, frame in enumerate(reference):
        fluid = frame[is_fluid].double()
        if before is not None and number % stride == 0:
            largest = max(largest, float(speeds(torch.stack([before, fluid]), scene.box, scene.frame_dt).max()))
        before = fluid
    return np.linspace(0, largest or 1.0, SPEED_BINS + 1)


class RolloutMeter:
    """Takes the frames of a rollout and the stored ones as they come, and gives their metrics; it keeps no frames.

    Args:
        first: The frame that the rollout begins with, (N, D).
        masses: (N,).
        is_fluid: Which particles are fluid, (N,), bool.
        scene: Their scene.
        stride: Frames from one that is looked at to the next; the squared errors are of every frame.
        sinkhorn_stride: Of the frames that are looked at, every so many-th has a Sinkhorn divergence; 0 for none.
        speed_edges: Edges of the bins of speeds, see `speed_edges`.
        most_points: Limit of `sinkhorn_divergence`.

    Raises:
        DataError: If the fluid has no mass.
    """

    def __init__(
        self,
        first: Tensor,
        masses: Tensor,
        is_fluid: Tensor,
        scene: Scene,
        *,
        stride: int,
        sinkhorn_stride: int,
        speed_edges: np.ndarray,
        most_points: int = MOST_POINTS,
    ):
        check_masses(masses, is_fluid)
        self._masses, self._is_fluid, self._scene = masses.double(), is_fluid, scene
        self._stride, self._sinkhorn_stride, self._most_points = stride, sinkhorn_stride, most_points
        self._edges = speed_edges
        self._paths: tuple[_Path, ...] = (_Path.of(first), _Path.of(first))
        self._errors: list[float] = []
        self._looks: list[_Look] = []

    def __len__(self) -> int:
        """Frames that were taken."""
        return len(self._errors)

    def add(self, positions: Tensor, stored: Tensor) -> None:
        """Take the next frame of the rollout and the stored one, (N, D) each."""
        paths = tuple(path.followed_by(frame) for path, frame in zip(self._paths, (positions, stored), strict=True))
        error = float(squared_errors(paths[0].now[None], paths[1].now[None], self._scene.box))
        looks = [self._look(paths, len(self) + 1)] if (len(self) + 1) % self._stride == 0 else []
        self._paths = paths
        self._errors.append(error)
        self._looks += looks

    def metrics(self) -> RolloutMetrics:
        """Metrics of the frames so far, of which there is at least one; of the last where none was looked at."""
        looks = self._looks or [self._look(self._paths, len(self))]
        transported = [look for look in looks if look.sinkhorn is not None]
        found, stored = (_series([look.flows[side] for look in looks]) for side in (0, 1))
        return RolloutMetrics(
            frames=np.array([look.frame for look in looks]),
            mse=np.array(self._errors),
            e_kin_mse=np.square(found.e_kin - stored.e_kin),
            chamfer=np.array([look.chamfer for look in looks]),
            sinkhorn_frames=np.array([look.frame for look in transported], dtype=int),
            sinkhorn=np.array([look.sinkhorn for look in transported]),
            neighbors_distance=np.abs(found.neighbors - stored.neighbors).sum(axis=1) / 2,
            speeds_distance=np.array([look.speeds_distance for look in looks]),
            speed_edges=self._edges,
            rollout=found,
            reference=stored,
        )

    def _look(self, paths: "tuple[_Path, ...]", frame: int) -> "_Look":
        """Measure the last frame of both paths."""
        scene, fluid = self._scene, [path.of_particles(self._is_fluid) for path in paths]
        moving = [speeds(torch.stack([path.before, path.now]), scene.box, scene.frame_dt)[0].numpy() for path in fluid]
        pair, wanted = (fluid[0].now, fluid[1].now, scene.box), self._sinkhorn_stride
        transports = wanted > 0 and len(self._looks) % wanted == 0
        return _Look(
            frame=frame,
            chamfer=chamfer_distance(*pair),
            sinkhorn=sinkhorn_divergence(*pair, most_points=self._most_points) if transports else None,
            speeds_distance=wasserstein_distance(*moving),
            flows=tuple(
                self._flow(path, of_fluid) | {"speeds": speed_histogram(pace, self._edges)}
                for path, of_fluid, pace in zip(paths, fluid, moving, strict=True)
            ),
        )

    def _flow(self, path: "_Path", fluid: "_Path") -> dict[str, Any]:
        """Measures of the last frame of a path, by their names in `FlowMetrics`, without the speeds."""
        scene, is_fluid, spacing = self._scene, self._is_fluid, self._scene.particle_spacing
        volumes = self._masses / self._masses[is_fluid].mean() * spacing**scene.dim
        around = surroundings(path.now, volumes, scene.box, spacing).of(is_fluid)
        last = torch.stack([fluid.before, fluid.now])
        since = torch.stack([fluid.first, fluid.second, fluid.before, fluid.now])
        return {
            "e_kin": float(kinetic_energies(last, scene.box, spacing, scene.frame_dt)),
            "momentum_drift": float(momentum_drift(since, self._masses[is_fluid], scene.box)[-1]),
            "rho_mae": density_error(around.densities, FREE_SURFACE),
            "rho_mae_unclamped": density_error(around.densities),
            "rho_min": float(around.densities.min()),
            "rho_max": float(around.densities.max()),
            "dirichlet": dirichlet_energy(around.gradients, spacing),
            "neighbors": neighbor_histogram(around.neighbors),
        }


class _Path(NamedTuple):
    """The frames (N, D) of a path that its measures need: the first two, and the last two."""

    first: Tensor
    second: Tensor
    before: Tensor
    now: Tensor

    @classmethod
    def of(cls, first: Tensor) -> "_Path":
        """The path of a single frame."""
        return cls(*[first.double()] * 4)

    def followed_by(self, frame: Tensor) -> "_Path":
        """The path a frame later."""
        frame = frame.double()
        second = frame if self.second is self.first else self.second
        return _Path(self.first, second, self.now, frame)

    def of_particles(self, chosen: Tensor) -> "_Path":
        """The path of some particles."""
        return _Path(*(frame[chosen] for frame in self))


class _Look(NamedTuple):
    """What was measured at a frame; `flows` are the measures of the rollout and of the stored frames."""

    frame: int
    chamfer: float
    sinkhorn: float | None
    speeds_distance: float
    flows: tuple[dict[str, Any], ...]


def _series(flows: Sequence[dict[str, Any]]) -> FlowMetrics:
    """Measures of a path, frame after frame."""
    return FlowMetrics(**{name: np.stack([flow[name] for flow in flows]) for name in flows[0]})


def _plain(values: dict) -> dict:
    return {name: _plain(value) if isinstance(value, dict) else value.tolist() for name, value in values.items()}
