"""A column of water collapses in a tank, 2D.

Source: Colagrossi, Landrini, "Numerical simulation of interfacial flows by smoothed particle hydrodynamics", J. Comput.
Phys. 191 (2003); settings of LagrangeBench (Toshev et al., 2023), 2D_DB_5740_20kevery100.
"""

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from cconv.domain import Box
from cconv.scenes.simulated_scene import SimulatedScene
from cconv.scenes.walls import Walls, walls_around


@dataclass(frozen=True, kw_only=True)
class DamBreak2D(SimulatedScene):
    """Lengths in heights of the published column, gravity 1. Trajectories differ in how the particles start.

    Attributes:
        column: Length and height of the column.
        tank: Length and height of the tank.
    """

    particle_spacing: float = 0.02
    viscosity: float = 5e-5
    time_step: float = 3e-4
    num_frames: int = 401
    num_trajectories: int = 100
    column: tuple[float, float] = (2.0, 1.0)
    tank: tuple[float, float] = (5.366, 2.0)

    name = "dam_break_2d"
    case = "DB"
    dim = 2
    source = "LagrangeBench 2D_DB_5740_20kevery100"
    reference_speed = math.sqrt(2)
    density_scheme = "evolution"
    artificial_viscosity = 0.1
    gravity = (0.0, -1.0)
    free_surface = True
    sizes = {
        "published": {},
        "small": {
            "particle_spacing": 0.05,
            "time_step": 7e-4,
            "num_frames": 31,
            "num_trajectories": 8,
            "relaxation_steps": 300,
            "column": (1.0, 1.0),
            "tank": (2.5, 1.5),
        },
    }

    def _counts(self, lengths: tuple[float, float]) -> list[int]:
        return [round(length / self.particle_spacing) for length in lengths]

    @property
    def corner(self) -> tuple[float, ...]:
        """Of the space within the walls."""
        return (self.wall_thickness, self.wall_thickness)

    @property
    def box(self) -> Box:
        """The tank within its walls, and a tenth of room above and beside them, as published."""
        return Box((0.0, 0.0), [length + 2 * self.wall_thickness + 0.1 for length in self.tank])

    @property
    def walls(self) -> Walls:
        """The tank, lid included."""
        return walls_around(self._counts(self.tank), self.particle_spacing, self.corner)

    def fluid(self, generator: torch.Generator) -> tuple[Tensor, Tensor]:
        """A lattice relaxed in a closed box of the column's size, at rest."""
        counts = self._counts(self.column)
        closed = walls_around(counts, self.particle_spacing, self.corner)
        positions = self.relaxed_lattice(counts, self.corner, closed, generator)
        return positions, torch.zeros_like(positions)
