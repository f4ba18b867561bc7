"""A round drop that a straining flow turns into an ellipse, 2D, without walls or forces.

Source: Monaghan, "Simulating free surface flows with SPH", J. Comput. Phys. 110 (1994): the drop stays an
ellipse of constant area whose half axes follow an ordinary differential equation.
"""

from dataclasses import dataclass

import torch
from torch import Tensor

from cconv.domain import Box
from cconv.scenes.relaxed import glass
from cconv.scenes.simulated_scene import SimulatedScene


@dataclass(frozen=True, kw_only=True)
class FreeDrop2D(SimulatedScene):
    """Radius 1, starting velocity (-x, y). Trajectories differ in how the particles start."""

    particle_spacing: float = 0.04
    viscosity: float = 1e-4
    num_frames: int = 41
    steps_per_frame: int = 50
    num_trajectories: int = 8

    name = "free_drop_2d"
    case = "DROP"
    dim = 2
    source = "Monaghan (1994)"
    reference_speed = 1.0
    density_scheme = "evolution"
    artificial_viscosity = 0.05
    free_surface = True
    sizes = {
        "published": {},
        "small": {"particle_spacing": 0.1, "num_frames": 31, "steps_per_frame": 25, "relaxation_steps": 300},
    }

    @property
    def box(self) -> Box:
        """Open space around the drop, wide enough for all frames."""
        return Box((-4.0, -6.0), (4.0, 6.0))

    def fluid(self, generator: torch.Generator) -> tuple[Tensor, Tensor]:
        """The particles of a relaxed state that lie within the circle."""
        one = torch.ones(2, dtype=torch.float64)
        particles = glass(-one, one, self.particle_spacing, generator, self.relaxation_steps)
        positions = particles[particles.norm(dim=1) < 1]
        return positions, positions * torch.tensor([-1.0, 1.0], dtype=torch.float64)
