"""The base class of scenes that the solver computes: particles, walls, forces, settings and features."""

import math
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor

from cconv.domain import Box
from cconv.errors import ConfigError
from cconv.forces import ConstantForce, Force
from cconv.scenes.relaxed import relaxed
from cconv.scenes.walls import WALL_LAYERS, Walls, lattice
from cconv.sph.kernels import QuinticSpline
from cconv.sph.solver import (
    EquationOfState,
    ParticleState,
    Scheme,
    WeaklyCompressibleSPH,
    check_time_step,
    largest_time_step,
)


@dataclass(frozen=True, kw_only=True)
class SimulatedScene(ABC):
    """A scene at one size. Class attributes hold for every size.

    Attributes:
        particle_spacing: dx.
        viscosity: Kinematic viscosity ν.
        time_step: Time step of the solver; infinity for the largest that the CFL conditions allow.
        steps_per_frame: Steps between stored frames.
        num_frames: Stored frames of a trajectory, the start included.
        skipped_frames: Frames before the first that is stored, until the flow has developed.
        num_trajectories: Trajectories of a data set; a single one is cut in time.
        relaxation_steps: Steps that spread the particles at the start.
        sound_ratio: Speed of sound ÷ reference speed; densities deviate by about its inverse square from rest.

        name: Name of the scene.
        case: Name of the scene in LagrangeBench.
        dim: Number of space dimensions.
        source: Where the scene is defined.
        sizes: Settings of each size, "published" and "small".
        rest_density: ρ_0.
        reference_speed: Largest speed expected.
        background_pressure: Background pressure in units of ρ_0 c²/γ.
        density_scheme: "summation" or "evolution".
        artificial_viscosity: α as published, which belongs to a speed of sound of 10.
        gravity: Constant external acceleration, D numbers, or None.
        free_surface: Whether the fluid has one.
        varying_viscosity: Whether trajectories differ in viscosity.

    Raises:
        ConfigError: If a setting is impossible, or the time step violates a CFL condition.
    """

    particle_spacing: float
    viscosity: float
    time_step: float = math.inf
    steps_per_frame: int = 100
    num_frames: int = 101
    skipped_frames: int = 0
    num_trajectories: int = 8
    relaxation_steps: int = 1000
    sound_ratio: float = 10.0

    name: ClassVar[str]
    case: ClassVar[str]
    dim: ClassVar[int]
    source: ClassVar[str]
    sizes: ClassVar[dict[str, dict]]
    rest_density: ClassVar[float] = 1.0
    reference_speed: ClassVar[float] = 1.0
    background_pressure: ClassVar[float] = 0.0
    density_scheme: ClassVar[str] = "summation"
    artificial_viscosity: ClassVar[float] = 0.0
    gravity: ClassVar[tuple[float, ...] | None] = None
    free_surface: ClassVar[bool] = False
    varying_viscosity: ClassVar[bool] = False

    def __post_init__(self):
        for name in ("particle_spacing", "viscosity", "sound_ratio"):
            if not 0 < getattr(self, name) < math.inf:
                raise ConfigError(f"`{name}` must be positive, got {getattr(self, name)}.")
        for name, least in (("steps_per_frame", 1), ("num_frames", 1), ("num_trajectories", 1), ("skipped_frames", 0)):
            if getattr(self, name) < least:
                raise ConfigError(f"`{name}` must be at least {least}, got {getattr(self, name)}.")
        if self.time_step == math.inf:
            object.__setattr__(self, "time_step", largest_time_step(**self._scales))
        check_time_step(self.time_step, **self._scales)

    @property
    def _scales(self) -> dict[str, float]:
        return {
            "particle_spacing": self.particle_spacing,
            "sound_speed": self.equation_of_state.sound_speed,
            "reference_speed": self.reference_speed,
            "viscosity": self.viscosity,
            "force": self.largest_force,
        }

    @property
    @abstractmethod
    def box(self) -> Box:
        """Bounds and periodic axes."""

    @abstractmethod
    def fluid(self, generator: torch.Generator) -> tuple[Tensor, Tensor]:
        """Positions and velocities of the fluid at the start, both (N, D), float64."""

    @property
    def corner(self) -> tuple[float, ...]:
        """Lower corner of the space for fluid, which stays where it is in the flow if the particle spacing changes."""
        return self.box.lower

    @property
    def walls(self) -> Walls:
        """Wall particles; none by default."""
        return Walls.none(self.dim)

    @property
    def boundary(self) -> tuple[Tensor, Tensor] | None:
        """Points on the walls and normals into the fluid (B, D), where data sets hold them instead of particles."""
        return None

    @property
    def force(self) -> Force | None:
        """External acceleration, or None; gravity by default."""
        return None if self.gravity is None else ConstantForce(self.gravity)

    @property
    def largest_force(self) -> float:
        """Largest magnitude of the external acceleration."""
        return 0.0 if self.force is None else self.force.largest

    @property
    def features(self) -> dict[str, bool]:
        """Features of the scene, which a model of it may need."""
        walls = self.walls
        return {
            "walls": len(walls) > 0,
            "moving_walls": bool(walls.velocities.any()),
            "periodic": any(self.box.periodic),
            "force": self.force is not None,
            "free_surface": self.free_surface,
            "varying_viscosity": self.varying_viscosity,
        }

    def draw_viscosity(self, generator: torch.Generator) -> float:
        """Kinematic viscosity of a trajectory; the same for all by default."""
        return self.viscosity

    @property
    def frame_dt(self) -> float:
        """Time between stored frames."""
        return self.time_step * self.steps_per_frame

    @property
    def equation_of_state(self) -> EquationOfState:
        """Linear, with the speed of sound of the scene."""
        sound_speed = self.sound_ratio * self.reference_speed
        return EquationOfState(
            rest_density=self.rest_density,
            sound_speed=sound_speed,
            background_pressure=self.background_pressure * self.rest_density * sound_speed**2,
        )

    def solver(self) -> WeaklyCompressibleSPH:
        """A solver with the settings of the scene."""
        eos = self.equation_of_state
        return WeaklyCompressibleSPH(
            kernel=QuinticSpline(self.particle_spacing, self.dim),
            box=self.box,
            particle_spacing=self.particle_spacing,
            equation_of_state=eos,
            scheme=Scheme(
                density=self.density_scheme, artificial_viscosity=self.artificial_viscosity * 10 / eos.sound_speed
            ),
            force=self.force,
        )

    def initial_state(self, generator: torch.Generator) -> ParticleState:
        """Walls first, then fluid."""
        positions, velocities = self.fluid(generator)
        return self.state_of(self.walls, positions, velocities, self.draw_viscosity(generator))

    def state_of(
        self, walls: Walls, positions: Tensor, velocities: Tensor, viscosity: float, amid_flow: bool = False
    ) -> ParticleState:
        """State of walls and fluid particles, walls first.

        Args:
            walls: Wall particles.
            positions: Of the fluid (N, D).
            velocities: Of the fluid (N, D).
            viscosity: Kinematic viscosity ν of all particles.
            amid_flow: Whether the flow has a past, see `WeaklyCompressibleSPH.initial_state`.
        """
        particles = len(walls) + len(positions)
        mass = self.rest_density * self.particle_spacing**self.dim
        return self.solver().initial_state(
            torch.cat([walls.positions, positions]),
            torch.cat([walls.velocities, velocities]),
            masses=torch.full((particles,), mass, dtype=torch.float64),
            viscosities=torch.full((particles,), viscosity, dtype=torch.float64),
            is_wall=torch.arange(particles) < len(walls),
            amid_flow=amid_flow,
        )

    @property
    def wall_thickness(self) -> float:
        """Of the layers that the solver needs."""
        return WALL_LAYERS * self.particle_spacing

    def relaxed_lattice(
        self, counts: Sequence[int], lower: Sequence[float], walls: Walls, generator: torch.Generator
    ) -> Tensor:
        """Positions (N, D) of a lattice of `counts` cells from `lower` on, shaken and spread evenly between walls."""
        return relaxed(
            lattice(counts, self.particle_spacing, lower),
            box=self.box,
            walls=walls,
            spacing=self.particle_spacing,
            generator=generator,
            steps=self.relaxation_steps,
        )
