"""Particles carried by the decaying Taylor-Green vortices in a periodic unit box.

The flow is an exact solution of the incompressible Navier-Stokes equations, so velocities are exact at every particle
and any number of particles and frames costs next to nothing. No pressure keeps particles apart: the vortices stretch
the starting lattice, and beyond a time of about 0.5 particles clump.

Source: Taylor and Green (1937), https://doi.org/10.1098/rspa.1937.0036, in two dimensions; Reynolds number
as in the 2D set of LagrangeBench (Toshev et al., 2023).
"""

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from cconv.domain import Box
from cconv.errors import ConfigError


@dataclass(frozen=True, kw_only=True)
class TaylorGreen2D:
    """The scene. Lengths are in box lengths, speeds in the largest speed at the start.

    Attributes:
        particles_per_side: Particles along an axis of the starting lattice.
        viscosity: Kinematic viscosity nu; the Reynolds number is its inverse.
        frame_dt: Time between frames.
        jitter: Largest displacement of a particle from the lattice along an axis, as a fraction of the spacing.
        steps_per_frame: Runge-Kutta steps between frames.

    Raises:
        ConfigError: If a setting cannot be.
    """

    particles_per_side: int = 30
    viscosity: float = 0.01
    frame_dt: float = 0.01
    jitter: float = 0.25
    steps_per_frame: int = 4

    def __post_init__(self):
        for name, least in (("particles_per_side", 4), ("steps_per_frame", 1)):
            if getattr(self, name) < least:
                raise ConfigError(f"`{name}` must be at least {least}, got {getattr(self, name)}.")
        if not (self.viscosity >= 0 and 0 < self.frame_dt < math.inf and 0 <= self.jitter <= 0.5):
            raise ConfigError(
                "`viscosity` must be at least 0, `frame_dt` positive and `jitter` between 0 and 0.5, "
                f"got {self.viscosity}, {self.frame_dt} and {self.jitter}."
            )

    @property
    def box(self) -> Box:
        """The periodic unit box."""
        return Box((0.0, 0.0), (1.0, 1.0), periodic=True)

    @property
    def particle_spacing(self) -> float:
        """Spacing dx of the starting lattice."""
        return 1.0 / self.particles_per_side

    def random_phase(self, generator: torch.Generator) -> Tensor:
        """Where the vortices stand, (2,), uniform in the box."""
        return torch.rand(2, generator=generator, dtype=torch.float64)

    def initial_positions(self, generator: torch.Generator) -> Tensor:
        """A jittered lattice (N, 2), float64."""
        ticks = (torch.arange(self.particles_per_side, dtype=torch.float64) + 0.5) * self.particle_spacing
        lattice = torch.cartesian_prod(ticks, ticks)
        offsets = 2 * torch.rand(lattice.shape, generator=generator, dtype=torch.float64) - 1
        return self.box.wrap(lattice + self.jitter * self.particle_spacing * offsets)

    def velocity(self, positions: Tensor, time: float, phase: Tensor) -> Tensor:
        r"""Velocity of the fluid.

        .. math:: u = e^{-8 \pi^2 \nu t} (-\cos 2\pi x \sin 2\pi y, \; \sin 2\pi x \cos 2\pi y)

        with x and y measured from `phase`.

        Args:
            positions: Where, (..., 2), length.
            time: When.
            phase: Shift of the vortices, (2,), length.

        Returns:
            Velocities (..., 2), length per time.
        """
        x, y = (2 * math.pi * (positions - phase)).unbind(dim=-1)
        decay = math.exp(-8 * math.pi**2 * self.viscosity * time)
        return decay * torch.stack([-x.cos() * y.sin(), x.sin() * y.cos()], dim=-1)

    def advance(self, positions: Tensor, time: float, phase: Tensor) -> Tensor:
        """Positions (N, 2) one frame later: classical Runge-Kutta of fourth order along the flow, wrapped."""
        step = self.frame_dt / self.steps_per_frame
        for index in range(self.steps_per_frame):
            positions = self._runge_kutta_step(positions, time + index * step, step, phase)
        return self.box.wrap(positions)

    def _runge_kutta_step(self, positions: Tensor, time: float, step: float, phase: Tensor) -> Tensor:
        k1 = self.velocity(positions, time, phase)
        k2 = self.velocity(positions + step / 2 * k1, time + step / 2, phase)
        k3 = self.velocity(positions + step / 2 * k2, time + step / 2, phase)
        k4 = self.velocity(positions + step * k3, time + step, phase)
        return positions + step / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
