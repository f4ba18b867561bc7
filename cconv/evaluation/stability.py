"""Where methods fail: errors by regime, on stressed frames, by precision, and of a density integrated over frames.

A model that is accurate on average may fail at the free surface, where particles clump (tensile instability), or where
a scene is denser or faster than the training data. Each check has a threshold; a model that passes all is stable.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from copy import deepcopy
from dataclasses import asdict, dataclass, replace

import numpy as np
import torch
from torch import Tensor

from cconv.data.features import fluid_state
from cconv.data.targets import make_sample
from cconv.data.trajectory import Boundary, Frame, ParticleType, Scene, Trajectory
from cconv.domain import Box
from cconv.evaluation.metrics import frame_errors
from cconv.neighbors import radius_graph
from cconv.training.field_model import FieldModel

NOT_FINITE = 1e9  # stands for an error that is infinite or no number, so that files can hold it
NEAR = 2.0  # particle spacings within which neighbours are counted and walls are near


@dataclass(frozen=True, kw_only=True)
class Thresholds:
    """What a stable model must hold.

    Attributes:
        stressed_error: Largest error on a stressed frame, by the variance of that frame's own target.
        regime_error: Largest error in a regime, by the variance of the target over the training split.
        precision: Largest difference of float32 from float64, by the root mean square of the prediction.
        density: Largest deviation of an integrated density from its reference, relative; 0.02 as Neural SPH.
    """

    stressed_error: float = 0.5
    regime_error: float = 0.5
    precision: float = 1e-3
    density: float = 0.02


def measure_stability(
    model: FieldModel, trajectories: Sequence[Trajectory], scene: Scene, thresholds: Thresholds | None = None
) -> dict:
    """All checks of a model, as they stand in summary.json.

    Args:
        model: The model.
        trajectories: Trajectories that the model was not trained on.
        scene: Their scene.
        thresholds: What must hold.

    Returns:
        "regimes", "stress", "precision", "density_rollout" (None unless the model predicts the density rate), "stable",
        "failures" (one line each) and "thresholds".
    """
    thresholds = thresholds or Thresholds()
    frame = trajectories[0][len(trajectories[0]) // 2]
    rollout = density_rollout(model, trajectories[0], scene) if model.config.task == "density_rate" else None
    checks = {
        "regimes": regime_errors(model, [frame for trajectory in trajectories for frame in trajectory], scene),
        "stress": {name: stressed_error(model, *stressed) for name, stressed in stressed_frames(frame, scene).items()},
        "precision": precision(model, frame, scene),
        "density_rollout": rollout,
    }
    failures = _failures(checks, thresholds)
    return {**checks, "stable": not failures, "failures": failures, "thresholds": asdict(thresholds)}


def regime_errors(model: FieldModel, frames: Sequence[Frame], scene: Scene) -> dict[str, dict]:
    """Error and share of the particles of each regime: near walls, at the free surface, in the bulk; by number of
    neighbours and by speed, a quarter of the particles each.

    Near walls: a boundary point within 2 spacings. At the surface: elsewhere, with less than three quarters of the
    median number of neighbours within 2 spacings.
    """
    parts = [_particles(model, frame, scene) for frame in frames]
    errors, neighbors, near_wall, speeds = (torch.cat(values) for values in zip(*parts, strict=True))
    sparse = neighbors < 0.75 * neighbors.median()
    regimes = {
        "near_wall": near_wall,
        "free_surface": ~near_wall & sparse,
        "bulk": ~near_wall & ~sparse,
        **_quarters("neighbors", neighbors),
        **_quarters("speed", speeds),
    }
    return {
        name: {"normalized_mse": _finite(errors[members].mean()), "share": float(members.double().mean())}
        for name, members in regimes.items()
        if members.any()
    }


def stressed_error(model: FieldModel, frame: Frame, scene: Scene) -> float | None:
    """Mean squared error of a frame by the variance of its own target; None where that is constant."""
    (error,) = frame_errors(model, [make_sample(frame, scene, model.config.task, model.kernel)])
    relative = error.per_frame_normalized_mse
    return None if relative is None else _finite(relative)


def stressed_frames(frame: Frame, scene: Scene, seed: int = 0) -> dict[str, tuple[Frame, Scene]]:
    """A frame as it is, and in states in which methods fail, each with its scene.

    Clumped pairs, stretched and compressed along the first axis, isolated particles, half and double spacing of the
    same particles, turned and mirrored, and ten times as fast.
    """
    generator = torch.Generator().manual_seed(seed)
    axis = torch.zeros(scene.dim, dtype=torch.float64)
    axis[0] = 1.0

    def scaled(factors: Tensor) -> tuple[Frame, Scene]:
        return _moved(frame, scene, torch.diag(factors), lambda velocities: velocities)

    ones = torch.ones(scene.dim, dtype=torch.float64)
    stressed = {
        "as_it_is": (frame, scene),
        "clumped": (_clumped(frame, scene, generator), scene),
        "stretched": scaled(ones + 0.3 * axis),
        "compressed": scaled(ones - 0.15 * axis),
        "isolated": (_isolated(frame, scene, generator), scene),
        "half_spacing": scaled(0.5 * ones),
        "double_spacing": scaled(2.0 * ones),
        "mirrored": _turned(frame, scene, torch.diag(ones - 2 * axis)),
        "ten_times_as_fast": (replace(frame, velocities=10 * frame.velocities), scene),
    }
    if scene.dim > 1:
        quarter = torch.eye(scene.dim, dtype=torch.float64)
        quarter[:2, :2] = torch.tensor([[0.0, -1.0], [1.0, 0.0]])
        stressed["turned"] = _turned(frame, scene, quarter)
    return stressed


@torch.no_grad()
def precision(model: FieldModel, frame: Frame, scene: Scene) -> float:
    """Largest difference between predictions in float32 and float64, by the root mean square of the prediction."""
    sample = make_sample(frame, scene, model.config.task, model.kernel)
    exact = deepcopy(model).double().predict(sample.inputs.double())
    difference = (model.predict(sample.inputs).double() - exact).abs().max()
    return _finite(difference / exact.square().mean().sqrt().clamp_min(torch.finfo(torch.float64).tiny))


@torch.no_grad()
def density_rollout(model: FieldModel, trajectory: Trajectory, scene: Scene, limit: float = 0.02) -> dict:
    """Dρ/Dt along a stored trajectory, integrated by the trapezoidal rule: the model's and the analytic one.

    Returns:
        "frames"; "drift", the mean relative deviation at the last frame; "largest", the deviation that nineteen of
        twenty particles keep; "first_frame_outside", the first at which it exceeds `limit`, or None.
    """
    rates, references = [], []
    for frame in trajectory:
        sample = make_sample(frame, scene, model.config.task, model.kernel)
        rates.append(model.predict(sample.inputs)[:, 0].double())
        references.append(sample.target[:, 0].double())
    start = fluid_state(trajectory[0], scene.box, model.kernel).densities
    integrated, reference = (_integrate(start, torch.stack(values), scene.frame_dt) for values in (rates, references))
    deviations = integrated / reference - 1
    usual = deviations.abs().quantile(0.95, dim=1)
    outside = (~(usual <= limit)).nonzero()[:, 0]
    return {
        "frames": len(trajectory),
        "drift": _finite(deviations[-1].mean()),
        "largest": _finite(usual.max()),
        "first_frame_outside": int(outside[0]) if len(outside) else None,
    }


def _finite(value: Tensor | float) -> float:
    return float(value) if math.isfinite(value) else NOT_FINITE


def _integrate(start: Tensor, rates: Tensor, dt: float) -> Tensor:
    steps = dt * (rates[1:] + rates[:-1]) / 2
    return torch.cat([start[None], start + steps.cumsum(dim=0)])


def _failures(checks: Mapping, thresholds: Thresholds) -> list[str]:
    failures = [
        f"error {regime['normalized_mse']:.3g} in regime {name} (limit {thresholds.regime_error:g})"
        for name, regime in checks["regimes"].items()
        if not regime["normalized_mse"] <= thresholds.regime_error
    ]
    failures += [
        f"error {error:.3g} on the frame {name} (limit {thresholds.stressed_error:g})"
        for name, error in checks["stress"].items()
        if error is not None and not error <= thresholds.stressed_error
    ]
    if not checks["precision"] <= thresholds.precision:
        failures.append(f"float32 is {checks['precision']:.3g} from float64 (limit {thresholds.precision:g})")
    rollout = checks["density_rollout"]
    if rollout and not rollout["largest"] <= thresholds.density:
        failures.append(
            f"integrated density deviates by {rollout['largest']:.3g} (limit {thresholds.density:g}), "
            f"first at frame {rollout['first_frame_outside']}"
        )
    return failures


@torch.no_grad()
def _particles(model: FieldModel, frame: Frame, scene: Scene) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Squared error, number of neighbours, whether a wall is near, and speed of each fluid particle."""
    sample = make_sample(frame, scene, model.config.task, model.kernel)
    inputs = sample.inputs
    predicted = model(inputs, model.geometry(inputs))
    errors = (predicted - model.standardize_target(sample.target)).double().square().mean(dim=1)
    edges = radius_graph(inputs.positions, NEAR * scene.particle_spacing, scene.box)
    near = torch.zeros(inputs.num_particles, dtype=torch.bool)
    if frame.boundary is not None:
        walls = radius_graph(
            inputs.boundary_positions, NEAR * scene.particle_spacing, scene.box, queries=inputs.positions
        )
        near = walls.row_splits.diff() > 0
    speeds = frame.velocities[frame.particle_types == ParticleType.FLUID].double().norm(dim=1)
    return errors, edges.row_splits.diff().double(), near, speeds


def _quarters(name: str, values: Tensor) -> dict[str, Tensor]:
    """Members of the four quarters of the particles by a value; equal values stay together."""
    edges = torch.from_numpy(np.quantile(values.numpy(), [0.25, 0.5, 0.75]))
    places = torch.searchsorted(edges, values)
    return {f"{name}_quarter_{quarter + 1}": places == quarter for quarter in range(4)}


def _moved(
    frame: Frame, scene: Scene, matrix: Tensor, of_velocities: Callable[[Tensor], Tensor]
) -> tuple[Frame, Scene]:
    """A frame whose points are mapped by a diagonal or signed permutation matrix (D, D), with its box."""
    corners = torch.tensor([scene.box.lower, scene.box.upper], dtype=torch.float64) @ matrix.T
    periodic = tuple(bool(axis) for axis in matrix.abs() @ torch.tensor(scene.box.periodic, dtype=torch.float64) > 0)
    box = Box(corners.amin(dim=0).tolist(), corners.amax(dim=0).tolist(), periodic)

    def mapped(points: Tensor) -> Tensor:
        return (points.double() @ matrix.T).to(points.dtype)

    boundary = frame.boundary
    if boundary is not None:
        normals = None if boundary.normals is None else of_velocities(boundary.normals)
        boundary = Boundary(positions=mapped(boundary.positions), normals=normals)
    positions = box.wrap(mapped(frame.positions))
    moved = replace(frame, positions=positions, velocities=of_velocities(frame.velocities), boundary=boundary)
    return moved, replace(scene, box=box)


def _turned(frame: Frame, scene: Scene, matrix: Tensor) -> tuple[Frame, Scene]:
    return _moved(frame, scene, matrix, lambda vectors: (vectors.double() @ matrix.T).to(vectors.dtype))


def _clumped(frame: Frame, scene: Scene, generator: torch.Generator) -> Frame:
    """One fluid particle in twenty is put a tenth of a spacing beside its nearest neighbour."""
    fluid = (frame.particle_types == ParticleType.FLUID).nonzero()[:, 0]
    positions = frame.positions.double().clone()
    edges = radius_graph(positions[fluid], NEAR * scene.particle_spacing, scene.box)
    for particle in torch.randperm(len(fluid), generator=generator)[: max(1, len(fluid) // 20)].tolist():
        row = slice(int(edges.row_splits[particle]), int(edges.row_splits[particle + 1]))
        if row.start == row.stop:
            continue
        nearest = row.start + int(edges.distances[row].argmin())
        direction = edges.displacements[nearest] / edges.distances[nearest].clamp_min(1e-12)
        target = positions[fluid[edges.senders[nearest]]]
        positions[fluid[particle]] = target + 0.1 * scene.particle_spacing * direction
    return replace(frame, positions=scene.box.wrap(positions).to(frame.positions.dtype))


def _isolated(frame: Frame, scene: Scene, generator: torch.Generator) -> Frame:
    """Five fluid particles lose all neighbours within four spacings but one, or all."""
    fluid = (frame.particle_types == ParticleType.FLUID).nonzero()[:, 0]
    chosen = torch.randperm(len(fluid), generator=generator)[:5]
    edges = radius_graph(frame.positions[fluid].double(), 4 * scene.particle_spacing, _fitting(scene, 4.0))
    lost = torch.zeros(len(fluid), dtype=torch.bool)
    for number, particle in enumerate(chosen.tolist()):
        senders = edges.senders[edges.row_splits[particle] : edges.row_splits[particle + 1]]
        lost[senders[number % 2 :]] = True
    lost[chosen] = False
    keep = torch.ones(len(frame.positions), dtype=torch.bool)
    keep[fluid[lost]] = False
    return replace(
        frame,
        positions=frame.positions[keep],
        velocities=frame.velocities[keep],
        masses=frame.masses[keep],
        particle_types=frame.particle_types[keep],
    )


def _fitting(scene: Scene, spacings: float) -> Box:
    """The scene's box, open where it is too narrow for a search of so many spacings."""
    reach = 2 * spacings * scene.particle_spacing
    periodic = tuple(
        wraps and length >= reach for wraps, length in zip(scene.box.periodic, scene.box.lengths, strict=True)
    )
    return Box(scene.box.lower, scene.box.upper, periodic)
