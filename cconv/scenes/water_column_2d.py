"""Water at rest under gravity in an open box, 2D, which a solver or network must leave at rest.

Source: hydrostatics; pressure ρ_0 g (H - y). The test is from Adami, Hu, Adams, J. Comput. Phys. 231 (2012).
"""

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from cconv.domain import Box
from cconv.scenes.simulated_scene import SimulatedScene
from cconv.scenes.walls import Walls, walls_around, whole_cells


@dataclass(frozen=True, kw_only=True)
class WaterColumn2D(SimulatedScene):
    """Depth and width 1, gravity 1. Trajectories differ in how the particles start; the first motion dies out."""

    particle_spacing: float = 0.02
    viscosity: float = 0.01
    num_frames: int = 101
    num_trajectories: int = 8

    name = "water_column_2d"
    case = "CW"
    dim = 2
    source = "Adami, Hu, Adams (2012)"
    reference_speed = math.sqrt(2)
    density_scheme = "evolution"
    artificial_viscosity = 0.1
    gravity = (0.0, -1.0)
    free_surface = True
    sizes = {
        "published": {},
        "small": {"particle_spacing": 0.05, "num_frames": 41, "steps_per_frame": 25, "relaxation_steps": 300},
    }

    @property
    def corner(self) -> tuple[float, ...]:
        """Of the space within the walls."""
        return (self.wall_thickness, self.wall_thickness)

    @property
    def _counts(self) -> tuple[int, int]:
        cells = whole_cells(1.0, self.particle_spacing)
        return cells, cells

    @property
    def box(self) -> Box:
        """The water, its walls, and as much room above."""
        around = 2 * self.wall_thickness
        return Box((0.0, 0.0), (1 + around, 1.5 + around))

    @property
    def walls(self) -> Walls:
        """Bottom, sides and lid of the box."""
        across, up = self._counts
        return walls_around((across, up + up // 2), self.particle_spacing, self.corner)

    def fluid(self, generator: torch.Generator) -> tuple[Tensor, Tensor]:
        """A lattice relaxed in a closed box of the water's size, at rest."""
        closed = walls_around(self._counts, self.particle_spacing, self.corner)
        positions = self.relaxed_lattice(self._counts, self.corner, closed, generator)
        return positions, torch.zeros_like(positions)
