"""Check of the errors in regimes: groups of particles near walls, at the free surface, fast or crowded."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from cconv.data.trajectory import Frame, ParticleType, Scene
from cconv.evaluation.checks.check import Check, Finding
from cconv.evaluation.checks.material import SCALED, Material, squared_errors
from cconv.evaluation.checks.predictor import Predictor
from cconv.neighbors import radius_graph

NEAR = 2.0  # particle spacings within which neighbours are counted and walls are near


@dataclass(frozen=True, kw_only=True)
class Regime:
    """A group of particles with a common property.

    Attributes:
        name: Name of the regime.
        members: Mask over the fluid particles of all plain frames, one frame after the other, bool.
        scale: Divisor of squared errors.
    """

    name: str
    members: Tensor
    scale: float

    @property
    def share(self) -> float:
        """Share of the particles that belong to the regime."""
        return float(self.members.double().mean())


class Regimes(Check[Material, Predictor]):
    """Mean squared error of the particles of each regime ÷ its scale."""

    name = "regimes"
    sentence = f"Mean squared error of particles with a common property, on unchanged frames, {SCALED}."
    failure = "error {value:.3g} in regime {label} (limit {limit:g})"
    limit = 0.1

    def __init__(self, material: Material):
        super().__init__(material)
        self.regimes = list(_regimes(material))

    def findings(self, predictor: Predictor) -> list[Finding]:
        """Return a finding for each regime that has particles."""
        errors = torch.cat([squared_errors(predictor, probe) for probe in self.material.plain])
        return [
            self._finding(each.name, errors[each.members].mean() / each.scale, f"{100 * each.share:.3g} % of particles")
            for each in self.regimes
        ]


def _regimes(material: Material) -> Iterator[Regime]:
    """List the regimes that have particles."""
    targets = torch.cat([probe.target for probe in material.plain])
    for name, members in _members([probe.frame for probe in material.plain], material.scene).items():
        if members.any():
            yield Regime(name=name, members=members, scale=material.scale(targets[members]))


def _members(frames: Sequence[Frame], scene: Scene) -> dict[str, Tensor]:
    """Return a mask of the particles of each regime, by its name.

    The regimes are: near walls, at the free surface, in the bulk, at periodic faces; quarters of the particles by
    number of neighbours and by speed; the fastest hundredth.

    Near walls: a boundary point within 2 spacings. At the surface: elsewhere, with less than three quarters of the
    median number of neighbours within 2 spacings. At a periodic face: within 2 spacings of it.
    """
    parts = [_surroundings(frame, scene) for frame in frames]
    neighbors, near_wall, at_face, speeds = (torch.cat(values) for values in zip(*parts, strict=True))
    sparse = neighbors < 0.75 * neighbors.median()
    return {
        "near_wall": near_wall,
        "free_surface": ~near_wall & sparse,
        "bulk": ~near_wall & ~sparse,
        "periodic_face": at_face,
        **_quarters("neighbors", neighbors),
        **_quarters("speed", speeds),
        "fastest_percent": speeds >= np.quantile(speeds.numpy(), 0.99),
    }


def _surroundings(frame: Frame, scene: Scene) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Return number of neighbours, nearness of walls and periodic faces, and speed of each particle."""
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
    """Split the particles into four quarters by a value; equal values stay together."""
    edges = torch.from_numpy(np.quantile(values.numpy(), [0.25, 0.5, 0.75]))
    places = torch.searchsorted(edges, values)
    return {f"{name}_quarter_{quarter + 1}": places == quarter for quarter in range(4)}
