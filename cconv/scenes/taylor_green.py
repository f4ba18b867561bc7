"""Decaying Taylor-Green vortices in a periodic box, 2D and 3D.

Source: Taylor and Green (1937), https://doi.org/10.1098/rspa.1937.0036; settings of LagrangeBench (Toshev et al.,
2023), 2D_TGV_2500_10kevery100 and 3D_TGV_8000_10kevery100.
"""

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from cconv.domain import Box
from cconv.scenes.simulated_scene import SimulatedScene
from cconv.scenes.walls import whole_cells


@dataclass(frozen=True, kw_only=True)
class TaylorGreen2D(SimulatedScene):
    """Reynolds number 100. Trajectories differ in how the particles start."""

    particle_spacing: float = 0.02
    viscosity: float = 0.01
    time_step: float = 4e-4
    num_frames: int = 126
    num_trajectories: int = 200

    name = "taylor_green_2d"
    case = "TGV"
    dim = 2
    source = "LagrangeBench 2D_TGV_2500_10kevery100"
    sizes = {
        "published": {},
        "small": {
            "particle_spacing": 1 / 24,
            "time_step": 8e-4,
            "steps_per_frame": 25,
            "num_frames": 41,
            "num_trajectories": 8,
            "relaxation_steps": 300,
        },
    }

    @property
    def box(self) -> Box:
        """The periodic unit box."""
        return Box((0.0, 0.0), (1.0, 1.0), periodic=True)

    def fluid(self, generator: torch.Generator) -> tuple[Tensor, Tensor]:
        """A relaxed lattice that moves with the vortices."""
        cells = whole_cells(1.0, self.particle_spacing)
        positions = self.relaxed_lattice([cells] * 2, self.box.lower, self.walls, generator)
        return positions, self.velocity(positions, 0.0)

    def velocity(self, positions: Tensor, time: float) -> Tensor:
        r"""Velocity of the incompressible flow (N, 2), exactly.

        .. math:: u = e^{-8 \pi^2 \nu t} (-\cos 2\pi x \sin 2\pi y, \; \sin 2\pi x \cos 2\pi y)
        """
        x, y = (2 * math.pi * positions).unbind(dim=-1)
        decay = math.exp(-8 * math.pi**2 * self.viscosity * time)
        return decay * torch.stack([-x.cos() * y.sin(), x.sin() * y.cos()], dim=-1)


@dataclass(frozen=True, kw_only=True)
class TaylorGreen3D(SimulatedScene):
    """Reynolds number 50. Trajectories differ in how the particles start."""

    particle_spacing: float = 2 * math.pi / 20
    viscosity: float = 0.02
    time_step: float = 5e-3
    num_frames: int = 61
    num_trajectories: int = 400

    name = "taylor_green_3d"
    case = "TGV"
    dim = 3
    source = "LagrangeBench 3D_TGV_8000_10kevery100"
    sizes = {
        "published": {},
        "small": {
            "particle_spacing": 2 * math.pi / 10,
            "time_step": 1e-2,
            "steps_per_frame": 25,
            "num_frames": 21,
            "num_trajectories": 6,
            "relaxation_steps": 200,
        },
    }

    @property
    def box(self) -> Box:
        """The periodic box of length 2π."""
        return Box((0.0,) * 3, (2 * math.pi,) * 3, periodic=True)

    def fluid(self, generator: torch.Generator) -> tuple[Tensor, Tensor]:
        r"""A relaxed lattice that moves with :math:`u = (\sin x \cos y \cos z, \; -\cos x \sin y \cos z, \; 0)`."""
        cells = whole_cells(2 * math.pi, self.particle_spacing)
        positions = self.relaxed_lattice([cells] * 3, self.box.lower, self.walls, generator)
        x, y, z = positions.unbind(dim=1)
        u = torch.stack([x.sin() * y.cos() * z.cos(), -x.cos() * y.sin() * z.cos(), torch.zeros_like(x)], dim=1)
        return positions, u
