"""Check of how particles are packed in rollouts: density, nearest neighbours, nearness to walls."""

import torch
from torch import Tensor

from cconv.data.trajectory import ParticleType
from cconv.data.window import Window
from cconv.evaluation.checks.rolled import Bound, SeriesCheck, relative_densities
from cconv.neighbors import Edges, radius_graph

NEAR = 3.0  # particle spacings within which nearest neighbours are searched
TOO_NEAR = 0.5  # particle spacings from a wall at which a particle counts as one that penetrates it


class Packing(SeriesCheck):
    """Density and distances of particles, against their spread in the stored frames."""

    name = "packing"
    sentence = (
        "Deviation of the SPH density from rest, of the densest and of the sparsest hundredth of the fluid; particle "
        "spacing divided by the distance of nearest neighbours, for the hundredth with the smallest distances; share "
        "of the fluid within half a spacing of a wall. Limits are 0.02 for densities, or what the stored frames have "
        "and a quarter more."
    )
    failure = "{label} {value:.3g} (limit {limit:.3g}; {detail})"
    bounds = {
        "too dense": Bound(0.02, 1.25),
        "too sparse": Bound(0.02, 1.25),
        "clumped": Bound(1.5, 1.25),
        "in walls": Bound(1e-3, 2.0),
    }
    stride = 5

    def series(self, positions: Tensor, start: Window) -> dict[str, Tensor]:
        """Quantities of every fifth frame; see `SeriesCheck.series`."""
        frames = [self._of_frame(each, start) for each in positions[:: self.stride]]
        return {label: torch.tensor([each[label] for each in frames]).double() for label in frames[0]}

    def _of_frame(self, positions: Tensor, start: Window) -> dict[str, float]:
        scene, task, fluid = self.material.scene, self.material.task, start.is_fluid
        kernel = task.kernel_at(scene.particle_spacing, scene.dim)
        edges = radius_graph(positions, max(kernel.support_radius, NEAR * scene.particle_spacing), scene.box)
        densities = relative_densities(start, edges, kernel, scene)
        nearest = torch.full((len(positions),), edges.cutoff, dtype=torch.float64)
        nearest.scatter_reduce_(0, edges.receivers.long(), edges.distances, "amin")
        found = {
            "too dense": float(densities.quantile(0.99)) - 1,
            "too sparse": 1 - float(densities.quantile(0.01)),
            "clumped": scene.particle_spacing / max(float(nearest[fluid].quantile(0.01)), 1e-9),
        }
        near = self._near_walls(positions, edges, start)
        return found if near is None else {**found, "in walls": float(near[fluid].double().mean())}

    def _near_walls(self, positions: Tensor, edges: Edges, start: Window) -> Tensor | None:
        """Tell which particles are nearer than `TOO_NEAR` to a wall particle or wall point; None without walls."""
        scene, reach = self.material.scene, TOO_NEAR * self.material.scene.particle_spacing
        walls = start.particle_types != ParticleType.FLUID
        if bool(walls.any()):
            near = walls[edges.senders] & (edges.distances < reach)
            return torch.zeros_like(walls).index_fill_(0, edges.receivers[near].long(), True)
        if start.boundary is None:
            return None
        return (
            radius_graph(start.boundary.positions.double(), reach, scene.box, queries=positions).row_splits.diff() > 0
        )
