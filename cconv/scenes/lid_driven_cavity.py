"""Lid-driven cavity: a box whose lid slides, 2D, and 3D with a periodic third axis.

Source: Ghia, Ghia, Shin, "High-Re solutions for incompressible flow" (1982); settings of LagrangeBench (Toshev et al.,
2023), 2D_LDC_2708_10kevery100 and 3D_LDC_8160_10kevery100.
"""

from dataclasses import dataclass, replace
from typing import ClassVar

import torch
from torch import Tensor

from cconv.domain import Box
from cconv.scenes.simulated_scene import SimulatedScene
from cconv.scenes.walls import Walls, walls_around, whole_cells


@dataclass(frozen=True, kw_only=True)
class _LidDrivenCavity(SimulatedScene):
    """Reynolds number 100. One long run, cut in time once the flow is developed.

    The lid spans the whole box, which is periodic along it: particles that slide out at one end enter at the other.
    """

    viscosity: float = 0.01
    num_trajectories: int = 1

    case = "LDC"
    background_pressure = 0.01
    depth: ClassVar[tuple[float, ...]] = ()

    @property
    def corner(self) -> tuple[float, ...]:
        """Of the space within the walls."""
        return (self.wall_thickness, self.wall_thickness, *(0.0 for _ in self.depth))

    @property
    def _counts(self) -> list[int]:
        return [whole_cells(length, self.particle_spacing) for length in (1.0, 1.0, *self.depth)]

    @property
    def box(self) -> Box:
        """The unit cavity within its walls."""
        side = 1 + 2 * self.wall_thickness
        return Box((0.0,) * self.dim, (side, side, *self.depth), (True, False, *(True for _ in self.depth)))

    @property
    def walls(self) -> Walls:
        """Walls at rest but for those above the cavity, which slide with speed 1."""
        at_rest = self._walls_at_rest
        lid = at_rest.positions[:, 1] > 1 + self.wall_thickness
        velocities = torch.zeros_like(at_rest.positions)
        velocities[lid, 0] = 1.0
        lowest_of_lid = at_rest.positions[:, 1] < 1 + self.wall_thickness + self.particle_spacing
        return replace(at_rest, velocities=velocities, stored=torch.where(lid, lowest_of_lid, at_rest.stored))

    @property
    def _walls_at_rest(self) -> Walls:
        return walls_around(
            self._counts, self.particle_spacing, self.corner, [True, True, *(False for _ in self.depth)]
        )

    def fluid(self, generator: torch.Generator) -> tuple[Tensor, Tensor]:
        """A relaxed lattice at rest."""
        positions = self.relaxed_lattice(self._counts, self.corner, self._walls_at_rest, generator)
        return positions, torch.zeros_like(positions)


@dataclass(frozen=True, kw_only=True)
class LidDrivenCavity2D(_LidDrivenCavity):
    """In two dimensions."""

    particle_spacing: float = 0.02
    time_step: float = 4e-4
    num_frames: int = 20_000
    skipped_frames: int = 1248

    name = "lid_driven_cavity_2d"
    dim = 2
    source = "LagrangeBench 2D_LDC_2708_10kevery100"
    sizes = {
        "published": {},
        "small": {
            "particle_spacing": 1 / 16,
            "time_step": 1.2e-3,
            "steps_per_frame": 25,
            "num_frames": 80,
            "skipped_frames": 20,
            "relaxation_steps": 300,
        },
    }


@dataclass(frozen=True, kw_only=True)
class LidDrivenCavity3D(_LidDrivenCavity):
    """In three dimensions, depth 0.5."""

    particle_spacing: float = 1 / 24
    time_step: float = 9e-4
    num_frames: int = 20_000
    skipped_frames: int = 555

    name = "lid_driven_cavity_3d"
    dim = 3
    depth = (0.5,)
    source = "LagrangeBench 3D_LDC_8160_10kevery100"
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
