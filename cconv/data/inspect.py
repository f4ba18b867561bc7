"""Plain facts about a data set, and its implausibilities."""

from collections import defaultdict
from collections.abc import Callable, Iterable

import torch

from cconv.data.dataset import Dataset
from cconv.data.fluid_checks import USUAL_CUTOFF
from cconv.data.plausibility import SharedFrames, first_of_each, trajectory_findings
from cconv.data.quantities import MOST_NEIGHBORS, mean_neighbors
from cconv.data.stored_frames import StoredFrames
from cconv.data.trajectory import Frame, ParticleType, Scene, Trajectory
from cconv.domain import Box
from cconv.errors import ConfigError
from cconv.neighbors import radius_graph


def inspect_dataset(
    dataset: Dataset,
    cutoff: float | None = None,
    progress: Callable[[Iterable, str], Iterable] = lambda items, label: items,
) -> dict:
    """Facts of a data set: strings, numbers, lists and None only, so that they can be written as JSON.

    Every trajectory is read, so damaged data are found. Lengths and times are in the units of the data.

    Args:
        dataset: The data set.
        cutoff: Radius of the neighbour counts; None means twice the particle spacing, or half of the shortest periodic
            axis where that is less.
        progress: Wraps the trajectories of a split to show progress, given a label.

    Raises:
        DataError: If the data are damaged.
        ConfigError: If the cutoff is not positive, exceeds half of a periodic axis or holds far too many neighbours.
    """
    scene = dataset.scene
    usual = min(USUAL_CUTOFF * scene.particle_spacing, scene.box.shortest_period / 2)
    cutoff = usual if cutoff is None else cutoff
    collected: dict[ParticleType | str, list] = defaultdict(list)
    splits, findings, shared = {}, [], SharedFrames()
    for split, blocks in dataset.splits.items():
        splits[split] = {"trajectories": len(blocks), "frames": 0}
        for k in progress(range(len(blocks)), split):
            stored = StoredFrames(dataset, split, k)
            splits[split]["frames"] += len(stored)
            for piece in stored.pieces():
                _collect(collected, piece, scene.box, cutoff)
                findings += [*trajectory_findings(piece, scene), *shared.findings(split, piece)]
    return {
        "path": str(dataset.path),
        "format": dataset.format,
        "name": scene.name,
        "sha256": dataset.fingerprint(),
        "splits": splits,
        **_scene_facts(scene),
        **_particle_facts(collected, cutoff),
        "missing": list(scene.missing),
        "findings": [finding.as_dict() for finding in first_of_each(findings)],
    }


def _scene_facts(scene: Scene) -> dict:
    return {
        "dim": scene.dim,
        "particle_spacing": scene.particle_spacing,
        "frame_dt": scene.frame_dt,
        "box": {
            "lower": list(scene.box.lower),
            "upper": list(scene.box.upper),
            "periodic": list(scene.box.periodic),
        },
        "force": None if scene.force is None else scene.force.declaration(),
        "velocity_source": scene.velocity_source,
        "mass_source": scene.mass_source,
    }


def _particle_facts(collected: dict[ParticleType | str, list], cutoff: float) -> dict:
    return {
        "particles": {kind.name.lower(): _range(collected[kind]) for kind in ParticleType if max(collected[kind])},
        "boundary": {"points": _range(collected["boundary_points"]), "normals": all(collected["normals"])},
        "mass": {"min": min(collected["mass_min"]), "max": max(collected["mass_max"])},
        "speed": {"mean": _mean(collected["speed_mean"]), "max": max(collected["speed_max"])},
        "neighbors": {
            "cutoff": cutoff,
            "mean": _mean(collected["neighbors_mean"]),
            "min": min(collected["neighbors_min"]),
            "max": max(collected["neighbors_max"]),
        },
    }


def _collect(collected: dict[ParticleType | str, list], trajectory: Trajectory, box: Box, cutoff: float) -> None:
    """Append what a trajectory, or a piece of it, has; neighbours are counted in its first and last frame."""
    for kind in ParticleType:
        collected[kind].append(int((trajectory.particle_types == kind).sum()))
    boundary = trajectory.boundary
    collected["boundary_points"].append(0 if boundary is None else len(boundary.positions))
    collected["normals"].append(boundary is not None and boundary.normals is not None)
    collected["mass_min"].append(float(trajectory.masses.min()))
    collected["mass_max"].append(float(trajectory.masses.max()))
    fluid = trajectory.particle_types == ParticleType.FLUID
    if not fluid.any():
        return
    speeds = torch.linalg.vector_norm(trajectory.velocities[:, fluid].double(), dim=-1)
    collected["speed_mean"].append(float(speeds.mean()))
    collected["speed_max"].append(float(speeds.max()))
    for frame in (trajectory[0], trajectory[-1]):
        counts = _fluid_neighbors(frame, box, cutoff)
        collected["neighbors_mean"].append(float(counts.double().mean()))
        collected["neighbors_min"].append(int(counts.min()))
        collected["neighbors_max"].append(int(counts.max()))


def _fluid_neighbors(frame: Frame, box: Box, cutoff: float) -> torch.Tensor:
    """Number of other fluid particles within `cutoff` of each fluid particle, (N,)."""
    positions = frame.positions[frame.particle_types == ParticleType.FLUID]
    _check_affordable(positions, cutoff)
    return radius_graph(positions, cutoff, box).row_splits.diff()


def _check_affordable(positions: torch.Tensor, cutoff: float) -> None:
    """Raise `ConfigError` if a cutoff, or the particle spacing that it was taken from, is far too large to count."""
    mean = mean_neighbors(positions, cutoff) if cutoff > 0 else 0.0
    if mean > MOST_NEIGHBORS:
        raise ConfigError(
            f"`cutoff` {cutoff:g} holds about {mean:.0f} neighbours a particle, at most {MOST_NEIGHBORS} are counted; "
            "give a smaller --cutoff, or a --particle-spacing that fits, as it is at most twice that by default."
        )


def _range(values: list[int]) -> dict:
    return {"min": min(values), "max": max(values)}


def _mean(values: list[float]) -> float:
    return sum(values) / len(values)
