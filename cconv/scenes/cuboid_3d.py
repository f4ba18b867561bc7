"""Random bodies of fluid fall into a closed box, 3D: the kind of scene that the thesis and its data sets use.

Source: the bachelor's thesis, section 3; Ummenhofer et al., "Lagrangian Fluid Simulation with Continuous Convolutions"
(ICLR 2020), whose data generator draws bodies, poses, velocities and viscosity as here.
"""

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from cconv.domain import Box
from cconv.scenes.relaxed import glass
from cconv.scenes.simulated_scene import SimulatedScene
from cconv.scenes.walls import Walls, lattice, walls_around, whole_cells


@dataclass(frozen=True, kw_only=True)
class Cuboid3D(SimulatedScene):
    """One to three bodies (blocks, balls, cylinders) with random pose, size and velocity; water in SI units.

    Data sets hold points on the walls with their normals instead of wall particles.

    Attributes:
        side: Inner length of the cubic box.
    """

    particle_spacing: float = 0.05
    viscosity: float = 0.01
    steps_per_frame: int = 100
    num_frames: int = 101
    num_trajectories: int = 20
    relaxation_steps: int = 300
    side: float = 1.6

    name = "cuboid_3d"
    case = "CUBOID"
    dim = 3
    source = "bachelor's thesis, section 3; Ummenhofer et al. (2020)"
    rest_density = 1000.0
    reference_speed = math.sqrt(2 * 9.81 * 1.6)
    density_scheme = "evolution"
    artificial_viscosity = 0.1
    gravity = (0.0, -9.81, 0.0)
    free_surface = True
    varying_viscosity = True
    sizes = {
        "published": {},
        "small": {
            "particle_spacing": 0.1,
            "side": 1.2,
            "steps_per_frame": 50,
            "num_frames": 41,
            "num_trajectories": 6,
            "relaxation_steps": 200,
        },
    }

    @property
    def _counts(self) -> list[int]:
        return [whole_cells(self.side, self.particle_spacing)] * 3

    @property
    def box(self) -> Box:
        """The cube from 0 to its side, and its walls around it."""
        return Box((-self.wall_thickness,) * 3, (self.side + self.wall_thickness,) * 3)

    @property
    def corner(self) -> tuple[float, ...]:
        """The origin."""
        return (0.0,) * 3

    @property
    def walls(self) -> Walls:
        """All six sides, none of them stored."""
        walls = walls_around(self._counts, self.particle_spacing, self.corner)
        return Walls(positions=walls.positions, velocities=walls.velocities, stored=torch.zeros_like(walls.stored))

    @property
    def boundary(self) -> tuple[Tensor, Tensor]:
        """A lattice of points on each side, normals inwards."""
        count = self._counts[0]
        on_side = lattice([count, count], self.particle_spacing, (0.0, 0.0))
        points, normals = [], []
        for axis in range(3):
            for place, direction in ((0.0, 1.0), (self.side, -1.0)):
                others = [other for other in range(3) if other != axis]
                at = torch.full((len(on_side), 3), place, dtype=torch.float64)
                at[:, others] = on_side
                points.append(at)
                normal = torch.zeros_like(at)
                normal[:, axis] = direction
                normals.append(normal)
        return torch.cat(points), torch.cat(normals)

    def draw_viscosity(self, generator: torch.Generator) -> float:
        """Up to ten times the smallest, evenly on a logarithmic scale."""
        return 0.1 * self.viscosity * 10 ** float(torch.rand((), generator=generator))

    def fluid(self, generator: torch.Generator) -> tuple[Tensor, Tensor]:
        """Particles of a relaxed state within the bodies, each body with a velocity of its own."""
        inner = torch.full((3,), 0.5 * self.particle_spacing, dtype=torch.float64)
        particles = glass(inner, self.side - inner, self.particle_spacing, generator, self.relaxation_steps)
        velocities = torch.zeros_like(particles)
        covered = torch.zeros(len(particles), dtype=torch.bool)
        for _ in range(int(torch.randint(1, 4, (), generator=generator))):
            inside = self._body(particles, generator) & ~covered
            velocities[inside] = _uniform(generator, (-2.0, -0.5, -2.0), (2.0, 0.5, 2.0))
            covered |= inside
        return particles[covered], velocities[covered]

    def _body(self, points: Tensor, generator: torch.Generator) -> Tensor:
        """Which of `points` (N, 3) lie within a random body."""
        half = _uniform(generator, (0.15,) * 3, (0.3,) * 3) * self.side
        centre = _uniform(generator, (0.3,) * 3, (0.7,) * 3) * self.side
        turned = (points - centre) @ _rotation(generator) / half
        shape = int(torch.randint(3, (), generator=generator))
        if shape == 0:
            return turned.abs().amax(dim=1) < 1
        if shape == 1:
            return turned.norm(dim=1) < 1
        return (turned[:, :2].norm(dim=1) < 1) & (turned[:, 2].abs() < 1)


def _uniform(generator: torch.Generator, low: tuple[float, ...], high: tuple[float, ...]) -> Tensor:
    lower, upper = (torch.tensor(bound, dtype=torch.float64) for bound in (low, high))
    return lower + (upper - lower) * torch.rand(len(low), generator=generator, dtype=torch.float64)


def _rotation(generator: torch.Generator) -> Tensor:
    """A random orthogonal matrix (3, 3)."""
    return torch.linalg.qr(torch.randn(3, 3, generator=generator, dtype=torch.float64)).Q
