"""What a model is asked to see whether it is stable: frames in many states, with the analytic answers."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from cconv.data.splits import evenly_spaced
from cconv.data.trajectory import Frame, ParticleType, Scene, Trajectory
from cconv.errors import DataError
from cconv.evaluation.stressed import State, still_states, stressed_states
from cconv.neighbors import radius_graph
from cconv.tasks.features import FluidState
from cconv.tasks.task import FieldTask

REGIME_FRAMES = 20  # frames whose particles are sorted into regimes
STRESSED_FRAMES = 3  # frames that are put into other states: the first, the middle one and the last
ROLLOUT_FRAMES = 30  # frames of a trajectory that the rate of density is integrated over
SMALLEST_SCALE = 0.1  # of the typical mean square, what errors are divided by where targets are smaller
NEAR = 2.0  # particle spacings within which neighbours are counted and walls are near


@dataclass(frozen=True, kw_only=True)
class Probe:
    """A frame in some state, and what a model should say of it.

    Attributes:
        name: Name of the state.
        origin: Which frame of the data it was made of.
        frame: Particles.
        scene: Their scene.
        target: Analytic field of its fluid particles, (N, C), float64.
        affected: Fluid particles whose errors count, (N,), bool.
        scale: What squared errors are divided by.
    """

    name: str
    origin: str
    frame: Frame
    scene: Scene
    target: Tensor
    affected: Tensor
    scale: float


@dataclass(frozen=True, kw_only=True)
class Regime:
    """Particles that have something in common.

    Attributes:
        members: Which of the fluid particles of all frames, one after the other, bool.
        scale: What squared errors are divided by.
    """

    members: Tensor
    scale: float

    @property
    def share(self) -> float:
        """Share of the particles that belong to it."""
        return float(self.members.double().mean())


@dataclass(frozen=True, kw_only=True)
class Rollout:
    """Consecutive frames along which a rate of density is integrated.

    Attributes:
        frames: Frames.
        scene: Their scene.
        targets: Analytic rate in each, (T, N), float64.
        densities: Density by summation in each, (T, N), float64.
    """

    frames: tuple[Frame, ...]
    scene: Scene
    targets: Tensor
    densities: Tensor


@dataclass(frozen=True, kw_only=True)
class Probes:
    """Everything that a model is asked; made once for all models.

    Attributes:
        typical: Variance of the target over the frames of the regimes.
        plain: Frames as they are.
        regimes: Regimes among the fluid particles of the plain frames.
        stressed: Frames in other states.
        still: Frames in which the rate of density is 0; none for other tasks.
        rollout: Frames to integrate over; None for tasks that predict no rate.
    """

    typical: float
    plain: tuple[Probe, ...]
    regimes: dict[str, Regime]
    stressed: tuple[Probe, ...]
    still: tuple[Probe, ...]
    rollout: Rollout | None


def make_probes(
    trajectories: Sequence[Trajectory], scene: Scene, task: FieldTask, reach: float | None = None
) -> Probes:
    """What models of a task are asked in a scene.

    Args:
        trajectories: Trajectories that no model was trained on.
        scene: Their scene.
        task: What is asked.
        reach: Largest distance that a model searches; the kernel's support by default.

    Raises:
        DataError: If there is no frame.
    """
    places = [(trajectory, index) for trajectory in trajectories for index in range(len(trajectory))]
    if not places:
        raise DataError("There is no validation frame to test stability on; give the split at least one.")
    chosen = [places[place] for place in evenly_spaced(len(places), REGIME_FRAMES)]
    kernel = task.kernel_at(scene.particle_spacing, scene.dim)
    states = [task.state(trajectory[index], scene) for trajectory, index in chosen]
    fields = torch.cat([task.field(state) for state in states])
    typical = max(float(fields.var(dim=0, correction=0).mean()), _rounding(states, task))
    reach = max(reach or 0.0, kernel.support_radius)
    fastest = max(float(state.velocities.norm(dim=1).max()) for state in states)

    def answered(state: State, origin: str) -> Probe:
        return _answered(state, origin, task, typical)

    origins = {_origin(*place): place for place in chosen}
    plain = [
        answered(State(name="as_it_is", frame=trajectory[index], scene=scene), origin)
        for origin, (trajectory, index) in origins.items()
    ]
    stressed, still = [], []
    for seed, place in enumerate(evenly_spaced(len(places), STRESSED_FRAMES)):
        trajectory, index = places[place]
        frame, origin = trajectory[index], _origin(trajectory, index)
        options = {"typical_rate": typical**0.5, "fastest": fastest, "reach": reach, "seed": seed}
        stressed += [answered(state, origin) for state in stressed_states(frame, scene, kernel, **options)]
        if not task.output.vectors:
            still += [answered(state, origin) for state in still_states(frame, scene, fastest)]
    return Probes(
        typical=typical,
        plain=tuple(plain),
        regimes=_regimes(plain, scene, typical),
        stressed=tuple(stressed),
        still=tuple(still),
        rollout=None if task.output.vectors else _rollout(trajectories[0], scene, task),
    )


def _origin(trajectory: Trajectory, index: int) -> str:
    return f"trajectory {trajectory.name}, frame {trajectory.first_frame + index}"


def _rounding(states: Sequence[FluidState], task: FieldTask) -> float:
    """Square of a field so small that float32 cannot tell it from 0."""
    density = max(float(state.densities.max()) for state in states)
    speed = 1.0 if task.output.vectors else max(float(state.velocities.norm(dim=1).max()) for state in states)
    return max((1e-4 * density * speed / states[0].kernel.smoothing_length) ** 2, torch.finfo(torch.float64).tiny)


def _answered(state: State, origin: str, task: FieldTask, typical: float) -> Probe:
    target = task.field(task.state(state.frame, state.scene))
    affected = torch.ones(len(target), dtype=torch.bool) if state.affected is None else state.affected
    return Probe(
        name=state.name,
        origin=origin,
        frame=state.frame,
        scene=state.scene,
        target=target,
        affected=affected,
        scale=_scale(target[affected], typical),
    )


def _scale(targets: Tensor, typical: float) -> float:
    """Mean square of the targets of some particles, but not less than a tenth of the typical one.

    So an error of 1 is as bad as predicting 0 for them, unless their targets are so small that they hardly matter.
    """
    return max(float(targets.square().mean()) if len(targets) else 0.0, SMALLEST_SCALE * typical)


def _rollout(trajectory: Trajectory, scene: Scene, task: FieldTask) -> Rollout:
    frames = tuple(trajectory[index] for index in range(min(len(trajectory), ROLLOUT_FRAMES)))
    states = [task.state(frame, scene) for frame in frames]
    return Rollout(
        frames=frames,
        scene=scene,
        targets=torch.stack([task.field(state)[:, 0] for state in states]),
        densities=torch.stack([state.densities for state in states]),
    )


def _regimes(plain: Sequence[Probe], scene: Scene, typical: float) -> dict[str, Regime]:
    """The particles of each regime: near walls, at the free surface, in the bulk, at periodic faces; by number of
    neighbours and by speed, a quarter of the particles each; the fastest one in a hundred.

    Near walls: a boundary point within 2 spacings. At the surface: elsewhere, with less than three quarters of the
    median number of neighbours within 2 spacings. At a periodic face: within 2 spacings of it.
    """
    parts = [_surroundings(probe.frame, scene) for probe in plain]
    targets = torch.cat([probe.target for probe in plain])
    neighbors, near_wall, at_face, speeds = (torch.cat(values) for values in zip(*parts, strict=True))
    sparse = neighbors < 0.75 * neighbors.median()
    regimes = {
        "near_wall": near_wall,
        "free_surface": ~near_wall & sparse,
        "bulk": ~near_wall & ~sparse,
        "periodic_face": at_face,
        **_quarters("neighbors", neighbors),
        **_quarters("speed", speeds),
        "fastest_percent": speeds >= np.quantile(speeds.numpy(), 0.99),
    }
    return {
        name: Regime(members=members, scale=_scale(targets[members], typical))
        for name, members in regimes.items()
        if members.any()
    }


def _surroundings(frame: Frame, scene: Scene) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Number of neighbours, whether a wall or a periodic face is near, and speed of each fluid particle."""
    fluid, reach = frame.particle_types == ParticleType.FLUID, NEAR * scene.particle_spacing
    positions = frame.positions[fluid].double()
    edges = radius_graph(positions, reach, scene.box)
    near_wall = torch.zeros(len(positions), dtype=torch.bool)
    if frame.boundary is not None:
        walls = radius_graph(frame.boundary.positions.double(), reach, scene.box, queries=positions)
        near_wall = walls.row_splits.diff() > 0
    lower, upper = (torch.tensor(corner, dtype=torch.float64) for corner in (scene.box.lower, scene.box.upper))
    inside = scene.box.wrap(positions)
    at_face = ((inside - lower < reach) | (upper - inside < reach)) & torch.tensor(scene.box.periodic)
    speeds = frame.velocities[fluid].double().norm(dim=1)
    return edges.row_splits.diff().double(), near_wall, at_face.any(dim=1), speeds


def _quarters(name: str, values: Tensor) -> dict[str, Tensor]:
    """Members of the four quarters of the particles by a value; equal values stay together."""
    edges = torch.from_numpy(np.quantile(values.numpy(), [0.25, 0.5, 0.75]))
    places = torch.searchsorted(edges, values)
    return {f"{name}_quarter_{quarter + 1}": places == quarter for quarter in range(4)}
