r"""Weakly compressible SPH: the equations of motion of particles, integrated step by step.

.. math::
    \frac{d\rho}{dt} = -\rho \nabla \cdot u, \qquad
    \frac{du}{dt} = -\frac{1}{\rho} \nabla p + \nu \nabla^2 u + g, \qquad
    p = \frac{\rho_0 c^2}{\gamma} \left( \left( \frac{\rho}{\rho_0} \right)^\gamma - 1 \right) + p_b

(Neural SPH, eqs. 1 to 3). Particles are moved by a transport velocity that a constant pressure keeps apart from the
momentum velocity, so that they stay evenly spread; walls are particles whose pressure and velocity are extrapolated
from the fluid.

Sources: Adami, Hu, Adams, "A generalized wall boundary condition for smoothed particle hydrodynamics", J. Comput. Phys.
231 (2012); Adami, Hu, Adams, "A transport-velocity formulation for smoothed particle hydrodynamics", J. Comput. Phys.
241 (2013); Zhang, Hu, Adams, "A weakly compressible SPH method based on a low-dissipation Riemann solver", J. Comput.
Phys. 335 (2017), for the renormalisation; Toshev et al., "JAX-SPH" (2024), for the integrator and its settings.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from operator import itemgetter

import numpy as np
import torch
from torch import Tensor

from cconv.domain import Box
from cconv.errors import ConfigError, ShapeError, SimulationError, check_choice, check_shape
from cconv.neighbors import radius_graph
from cconv.sph import pair_loops
from cconv.sph.kernel_table import kernel_tables
from cconv.sph.kernels import AbstractKernel
from cconv.sph.neighbor_list import NeighborList, moved, padded, periodic_lengths, unpadded

DENSITY_SCHEMES = ("summation", "evolution")
CFL = 0.25

Force = Callable[[Tensor], Tensor]


@dataclass(frozen=True, kw_only=True)
class EquationOfState:
    """Pressure of a weakly compressible fluid; linear for exponent 1, Tait's for 7.

    Attributes:
        rest_density: ρ_0, mass/length^D.
        sound_speed: c, about ten times the largest speed, so that densities vary by about one percent.
        exponent: γ.
        background_pressure: p_b, added to all pressures; only for fluids without a free surface.
    """

    rest_density: float = 1.0
    sound_speed: float = 10.0
    exponent: float = 1.0
    background_pressure: float = 0.0

    @property
    def reference_pressure(self) -> float:
        """ρ_0 c²/γ."""
        return self.rest_density * self.sound_speed**2 / self.exponent

    def pressure(self, densities: np.ndarray) -> np.ndarray:
        """p(ρ)."""
        compression = (densities / self.rest_density) ** self.exponent - 1
        return self.reference_pressure * compression + self.background_pressure

    def density(self, pressures: np.ndarray) -> np.ndarray:
        """ρ(p), the inverse."""
        ratio = (pressures - self.background_pressure) / self.reference_pressure + 1
        return self.rest_density * np.maximum(ratio, 0.0) ** (1 / self.exponent)


@dataclass(frozen=True, kw_only=True)
class Scheme:
    """Which variant of weakly compressible SPH a solver computes.

    Attributes:
        density: "summation" (D1; fluids without a free surface) or "evolution" (continuity equation).
        renormalize_every: Steps between renormalisations of evolved densities by a Shepard filter; 0 for none.
        transport_pressure: Pressure that spreads the particles evenly; 0 for particles that move with the fluid. Only
            for fluids without a free surface, where c² ρ_0 is usual.
        artificial_viscosity: α of the artificial viscosity between fluid particles.
        wall_friction: Whether walls hold the fluid (no slip) or let it slip freely.

    Raises:
        ConfigError: If the density's name is unknown, or summed densities are to be renormalised.
    """

    density: str = "summation"
    renormalize_every: int = 0
    transport_pressure: float = 0.0
    artificial_viscosity: float = 0.0
    wall_friction: bool = True

    def __post_init__(self) -> None:
        check_choice("density", self.density, DENSITY_SCHEMES)
        if self.density == "summation" and self.renormalize_every:
            raise ConfigError("`renormalize_every` must be 0 with summed densities: only evolved ones drift.")


@dataclass(frozen=True, kw_only=True)
class ParticleState:
    """Fluid and wall particles at one time. Tensors are float64.

    Attributes:
        positions: x (N, D).
        velocities: u of the momentum; of wall particles, the velocity at which the wall moves (N, D).
        transport_velocities: v that moves the particles; u without a transport pressure (N, D).
        densities: ρ (N,).
        masses: m (N,).
        viscosities: Kinematic viscosity ν (N,).
        is_wall: Which particles are walls (N,), bool.
        steps: Steps taken since the start.
    """

    positions: Tensor
    velocities: Tensor
    transport_velocities: Tensor
    densities: Tensor
    masses: Tensor
    viscosities: Tensor
    is_wall: Tensor
    steps: int = 0


def largest_time_step(
    *, particle_spacing: float, sound_speed: float, reference_speed: float, viscosity: float = 0.0, force: float = 0.0
) -> float:
    """Time step up to which sound, viscosity and force are resolved (Adami et al. 2012).

    Args:
        particle_spacing: dx.
        sound_speed: c.
        reference_speed: Largest speed expected.
        viscosity: Largest kinematic viscosity ν.
        force: Largest external acceleration.
    """
    return CFL * min(_time_scales(particle_spacing, sound_speed + reference_speed, viscosity, force).values())


def check_time_step(
    time_step: float,
    *,
    particle_spacing: float,
    sound_speed: float,
    reference_speed: float,
    viscosity: float = 0.0,
    force: float = 0.0,
) -> None:
    """Raise `ConfigError`, naming the condition, unless a time step is positive and at most `largest_time_step`."""
    scales = _time_scales(particle_spacing, sound_speed + reference_speed, viscosity, force)
    condition, scale = min(scales.items(), key=itemgetter(1))
    limit = CFL * scale
    if not 0 < time_step <= limit * (1 + 1e-9):
        raise ConfigError(
            f"`time_step` must be positive and at most {limit:.4g}, the limit set by {condition}, got {time_step:g}; "
            "take a smaller one, or none to have it chosen."
        )


def _time_scales(particle_spacing: float, signal_speed: float, viscosity: float, force: float) -> dict[str, float]:
    scales = {"the speed of sound": particle_spacing / signal_speed}
    if viscosity > 0:
        scales["viscosity"] = particle_spacing**2 / viscosity
    if force > 0:
        scales["the external force"] = math.sqrt(particle_spacing / force)
    return scales


class WeaklyCompressibleSPH:
    """Integrates `ParticleState`; keeps nothing but a list of neighbours, which holds until particles have moved.

    Args:
        kernel: W; its smoothing length is usually the particle spacing.
        box: Domain with its periodic axes.
        particle_spacing: dx.
        equation_of_state: Pressure of the fluid.
        scheme: Which variant of the method.
        force: External acceleration (N, D) at positions (N, D), or None.
        skin: Extra reach of the neighbour list, in particle spacings.

    Raises:
        ConfigError: If a setting cannot be.
    """

    def __init__(
        self,
        *,
        kernel: AbstractKernel,
        box: Box,
        particle_spacing: float,
        equation_of_state: EquationOfState,
        scheme: Scheme,
        force: Force | None = None,
        skin: float = 0.3,
    ):
        if kernel.dim != box.dim:
            raise ConfigError(f"`kernel` must have the dimension of `box` ({box.dim}), got {kernel.dim}.")
        if not skin >= 0:
            raise ConfigError(f"`skin` must be at least 0, got {skin}.")
        self.box, self.particle_spacing, self.equation_of_state = box, particle_spacing, equation_of_state
        self._kernel, self._tables = kernel, kernel_tables(kernel)
        self._scheme, self._force = scheme, force
        self._artificial = scheme.artificial_viscosity * kernel.smoothing_length * equation_of_state.sound_speed
        self._lengths = periodic_lengths(box)
        self._neighbors = NeighborList(box, kernel.support_radius, skin * particle_spacing)

    def initial_state(
        self,
        positions: Tensor,
        velocities: Tensor,
        masses: Tensor,
        viscosities: Tensor,
        is_wall: Tensor,
        amid_flow: bool = False,
    ) -> ParticleState:
        """State at the start: summed densities, or the rest density where densities are evolved.

        Amid a flow evolved densities begin as summed ones, but at least the rest density, because sums lack what is
        beyond a free surface.

        Args:
            positions: x (N, D).
            velocities: u (N, D); of wall particles, that of the wall.
            masses: m (N,).
            viscosities: ν (N,).
            is_wall: Which particles are walls (N,), bool.
            amid_flow: Whether the flow has a past, in which particles may have come to nearly the same place.

        Raises:
            ShapeError: If shapes or dtypes do not fit.
            ConfigError: If a particle lies outside the box, or two fluid particles overlap at the start of a flow.
        """
        particles = len(positions)
        check_shape("positions", positions.shape, (particles, self.box.dim))
        check_shape("velocities", velocities.shape, (particles, self.box.dim))
        for name, values in (("masses", masses), ("viscosities", viscosities), ("is_wall", is_wall)):
            check_shape(name, values.shape, (particles,))
        if particles == 0 or is_wall.dtype != torch.bool:
            raise ShapeError(f"`is_wall` must be bool of at least one particle, got {particles} of {is_wall.dtype}.")
        positions, velocities, masses, viscosities = (
            values.detach().double().clone() for values in (positions, velocities, masses, viscosities)
        )
        positions = self.box.wrap(positions)
        _check_inside(positions, self.box)
        if not amid_flow:
            _check_apart(positions, self.box, self.particle_spacing)
        state = ParticleState(
            positions=positions,
            velocities=velocities,
            transport_velocities=velocities.clone(),
            densities=torch.full((particles,), self.equation_of_state.rest_density, dtype=torch.float64),
            masses=masses,
            viscosities=viscosities,
            is_wall=is_wall.clone(),
        )
        evolved = self._scheme.density == "evolution"
        if evolved and not amid_flow:
            return state
        densities = torch.from_numpy(self._summed(_Arrays(state)))
        least = self.equation_of_state.rest_density if evolved else 0.0
        return replace(state, densities=densities.clamp(min=least))

    def step(self, state: ParticleState, time_step: float) -> ParticleState:
        """State one semi-implicit Euler step later: velocities first, then positions, then densities.

        The given state stays as it is. `check_time_step` says whether a time step is small enough.

        Raises:
            SimulationError: If a particle is no longer at a finite place, or left through an open side of the box.
        """
        now = _Arrays(state)
        accelerations, shifts, now.densities = self._accelerations(now)
        now.velocities = now.velocities + time_step * accelerations
        now.transport_velocities = now.velocities + 0.5 * time_step * shifts
        now.positions = moved(now.positions, now.transport_velocities, time_step, self.box)
        _check_whole(now.positions, self.box, state.steps + 1)
        now.densities = self._next_densities(now, time_step, state.steps + 1)
        return replace(
            state,
            positions=unpadded(now.positions, self.box.dim),
            velocities=unpadded(now.velocities, self.box.dim),
            transport_velocities=unpadded(now.transport_velocities, self.box.dim),
            densities=torch.from_numpy(now.densities),
            steps=state.steps + 1,
        )

    def _accelerations(self, now: "_Arrays") -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Accelerations (N, 3) and those of the transport velocity, zero for walls; densities (N,) of all."""
        table, slopes = self._tables
        support, eos = self._kernel.support_radius, self.equation_of_state
        rows = self._neighbors.rows(now.positions, now.is_wall)
        force = np.zeros_like(now.positions)
        if self._force is not None:
            force[:, : self.box.dim] = self._force(unpadded(now.positions, self.box.dim)).numpy()
        densities, pressures = now.densities, eos.pressure(now.densities)
        velocities, transport = now.velocities, now.transport_velocities
        if now.has_walls:
            velocities, transport = velocities.copy(), transport.copy()
            rows.visit(
                pair_loops.extrapolate_to_walls, now.positions, self._lengths, support, table, now.is_wall, force,
                densities, pressures, now.velocities, now.transport_velocities, velocities, transport,
            )  # fmt: skip
            densities = np.where(now.is_wall, eos.density(pressures), densities)
        accelerations, shifts = np.zeros_like(now.positions), np.zeros_like(now.positions)
        rows.visit(
            pair_loops.accelerations, now.positions, self._lengths, now.masses, support, slopes, now.is_wall,
            velocities, transport, densities, pressures, eos.rest_density * now.viscosities, self._scheme.wall_friction,
            float(self._scheme.transport_pressure), self._artificial, 0.01 * self._kernel.smoothing_length**2,
            accelerations, shifts,
        )  # fmt: skip
        return accelerations + np.where(now.is_wall[:, None], 0.0, force), shifts, densities

    def _next_densities(self, now: "_Arrays", time_step: float, steps: int) -> np.ndarray:
        if self._scheme.density == "summation":
            return self._summed(now)
        table, slopes = self._tables
        rows = self._neighbors.rows(now.positions, now.is_wall)
        common = (now.positions, self._lengths, now.masses, self._kernel.support_radius)
        rates = np.zeros_like(now.densities)
        rows.visit(pair_loops.density_rates, *common, slopes, now.is_wall, now.velocities, now.densities, rates)
        densities = now.densities + time_step * rates
        if self._scheme.renormalize_every and steps % self._scheme.renormalize_every == 0:
            evolved = densities.copy()
            rows.visit(pair_loops.shepard_densities, *common, table, now.is_wall, evolved, densities)
        return densities

    def _summed(self, now: "_Arrays") -> np.ndarray:
        densities = now.densities.copy()
        self._neighbors.rows(now.positions, now.is_wall).visit(
            pair_loops.sum_densities, now.positions, self._lengths, now.masses, self._kernel.support_radius,
            self._tables[0], now.is_wall, densities,
        )  # fmt: skip
        return densities


class _Arrays:
    """A state as numpy arrays, vectors padded to three components.

    The loop over steps stays away from torch's own operations: their threads would keep the cores busy between ours.
    """

    def __init__(self, state: ParticleState):
        self.positions, self.velocities, self.transport_velocities = (
            padded(vectors) for vectors in (state.positions, state.velocities, state.transport_velocities)
        )
        self.densities, self.masses, self.viscosities = (
            values.numpy() for values in (state.densities, state.masses, state.viscosities)
        )
        self.is_wall = state.is_wall.numpy()
        self.has_walls = bool(self.is_wall.any())


def _outside(positions: np.ndarray, box: Box) -> np.ndarray:
    """Which positions (N, D or more) lie beyond the bounds of the box (N,)."""
    along = positions[:, : box.dim]
    return np.any((along < box.lower) | (along > box.upper), axis=1)


def _check_inside(positions: Tensor, box: Box) -> None:
    outside = _outside(positions.numpy(), box)
    if outside.any():
        index = int(outside.argmax())
        place = ", ".join(f"{value:g}" for value in positions[index].tolist())
        raise ConfigError(
            f"`positions` must lie within the box, got {int(outside.sum())} outside, the first is particle {index} "
            f"at ({place}); move them or enlarge the box."
        )


def _check_apart(positions: Tensor, box: Box, particle_spacing: float) -> None:
    edges = radius_graph(positions, 0.1 * particle_spacing, box)
    if len(edges):
        first, second = int(edges.receivers[0]), int(edges.senders[0])
        raise ConfigError(
            f"`positions` must keep particles a tenth of the particle spacing apart, got particles {first} and "
            f"{second} at a distance of {float(edges.distances[0]):.3g}; move or remove one."
        )


def _check_whole(positions: np.ndarray, box: Box, steps: int) -> None:
    lost = _outside(positions, box) | ~np.isfinite(positions).all(axis=1)
    if lost.any():
        raise SimulationError(
            f"The simulation blew up at step {steps}: {int(lost.sum())} particles are no longer in the box; take "
            "a smaller time step or a larger speed of sound."
        )
