"""Reverse Poiseuille flow: two opposite forces in one periodic box, 2D and 3D.

Source: Fedosov, Caswell, Karniadakis, "Reverse Poiseuille flow: the numerical viscometer" (2008); settings of
LagrangeBench (Toshev et al., 2023), 2D_RPF_3200_20kevery100 and 3D_RPF_8000_10kevery100.
"""

from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor

from cconv.domain import Box
from cconv.forces import Force, ReversePoiseuilleForce
from cconv.scenes.simulated_scene import SimulatedScene
from cconv.scenes.walls import whole_cells


@dataclass(frozen=True, kw_only=True)
class _ReversePoiseuille(SimulatedScene):
    """Force 1 along x where y < 1, -1 where y > 1. One long run, cut in time once the flow is developed."""

    viscosity: float = 0.1
    num_trajectories: int = 1

    case = "RPF"
    depth: ClassVar[tuple[float, ...]] = ()

    @property
    def box(self) -> Box:
        """Periodic, length 1, height 2."""
        upper = (1.0, 2.0, *self.depth)
        return Box((0.0,) * self.dim, upper, periodic=True)

    @property
    def force(self) -> Force:
        """Forward in the lower half, backward in the upper."""
        return ReversePoiseuilleForce(magnitude=1.0, height=self.box.lengths[1])

    def fluid(self, generator: torch.Generator) -> tuple[Tensor, Tensor]:
        """A relaxed lattice at rest."""
        counts = [whole_cells(length, self.particle_spacing) for length in self.box.lengths]
        positions = self.relaxed_lattice(counts, self.box.lower, self.walls, generator)
        return positions, torch.zeros_like(positions)


@dataclass(frozen=True, kw_only=True)
class ReversePoiseuille2D(_ReversePoiseuille):
    """Reynolds number 10."""

    particle_spacing: float = 0.025
    time_step: float = 5e-4
    num_frames: int = 40_000
    skipped_frames: int = 998

    name = "reverse_poiseuille_2d"
    dim = 2
    source = "LagrangeBench 2D_RPF_3200_20kevery100"
    background_pressure = 0.05
    sizes = {
        "published": {},
        "small": {
            "particle_spacing": 1 / 12,
            "time_step": 1.5e-3,
            "steps_per_frame": 25,
            "num_frames": 80,
            "skipped_frames": 20,
            "relaxation_steps": 300,
        },
    }


@dataclass(frozen=True, kw_only=True)
class ReversePoiseuille3D(_ReversePoiseuille):
    """Reynolds number 10, depth 0.5."""

    particle_spacing: float = 0.05
    time_step: float = 1e-3
    num_frames: int = 20_000
    skipped_frames: int = 498

    name = "reverse_poiseuille_3d"
    dim = 3
    depth = (0.5,)
    source = "LagrangeBench 3D_RPF_8000_10kevery100"
    background_pressure = 0.02
    sizes = {
        "published": {},
        "small": {
            "particle_spacing": 1 / 14,
            "time_step": 1.5e-3,
            "steps_per_frame": 20,
            "num_frames": 40,
            "skipped_frames": 10,
            "relaxation_steps": 200,
        },
    }
