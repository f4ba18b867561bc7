"""What a network is given: features of fluid particles and boundary points, and their standardisation.

Networks know no metres, kilograms or seconds: lengths are in particle spacings, densities in rest densities, times in
intervals of stored frames. So a network holds at every resolution and in all units.
"""

from collections.abc import Iterable
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from cconv.data.trajectory import Boundary, Frame, ParticleType, Scene
from cconv.domain import Box
from cconv.neighbors import Edges, radius_graph
from cconv.sph.operators import density


@dataclass(frozen=True, kw_only=True)
class Units:
    """What a network's numbers are multiples of, in the units of the data.

    Attributes:
        length: Particle spacing dx.
        density: Rest density, mean mass of a fluid particle / dx^D.
        time: Time between stored frames.
    """

    length: float
    density: float
    time: float

    @property
    def velocity(self) -> float:
        """Spacings in a frame's time."""
        return self.length / self.time


def units_of(masses: Tensor, scene: Scene) -> Units:
    """Units of a frame whose fluid particles have masses (N,)."""
    mean_mass = float(masses.double().mean()) if len(masses) else 1.0
    return Units(
        length=scene.particle_spacing, density=mean_mass / scene.particle_spacing**scene.dim, time=scene.frame_dt
    )


@dataclass(frozen=True, kw_only=True)
class Inputs:
    """The fluid particles of a frame as a network sees them, in `units`.

    Attributes:
        positions: Fluid positions (N, D), particle spacings.
        features: [1, v, ρ] of each fluid particle, (N, D + 2), or [1, v], (N, D + 1).
        boundary_positions: (B, D), particle spacings, or None where the scene has no boundary.
        boundary_features: Normals (B, D), or ones (B, 1) where the data hold none; None without boundary.
        box: Bounds and periodic axes, particle spacings.
        units: What these numbers are multiples of.
    """

    positions: Tensor
    features: Tensor
    boundary_positions: Tensor | None
    boundary_features: Tensor | None
    box: Box
    units: Units

    @property
    def num_particles(self) -> int:
        """Number of fluid particles N."""
        return len(self.positions)

    def double(self) -> "Inputs":
        """The same in float64."""
        tensors = {name: value for name, value in vars(self).items() if isinstance(value, Tensor)}
        return replace(self, **{name: tensor.double() for name, tensor in tensors.items()})


@dataclass(frozen=True, kw_only=True)
class FluidState:
    """Fluid particles of a frame in float64, their SPH neighbours and densities.

    Attributes:
        positions: (N, D).
        velocities: (N, D).
        masses: (N,).
        densities: D1 over fluid particles, (N,).
        edges: Pairs within the kernel's support.
    """

    positions: Tensor
    velocities: Tensor
    masses: Tensor
    densities: Tensor
    edges: Edges

    def single(self) -> "FluidState":
        """The same in float32, as networks compute."""
        values = {name: value.float() for name, value in vars(self).items() if isinstance(value, Tensor)}
        return replace(self, **values, edges=self.edges.to(torch.float32))


def fluid_state(frame: Frame, box: Box, kernel) -> FluidState:
    """Fluid particles of `frame` with density by summation over fluid particles only, as in the thesis."""
    positions, velocities, masses = _fluid_particles(frame)
    edges = radius_graph(positions, kernel.support_radius, box)
    return FluidState(
        positions=positions,
        velocities=velocities,
        masses=masses,
        densities=density(masses, edges, kernel),
        edges=edges,
    )


def _fluid_particles(frame: Frame) -> tuple[Tensor, Tensor, Tensor]:
    """Positions, velocities and masses of the fluid particles in float64."""
    fluid = frame.particle_types == ParticleType.FLUID
    return frame.positions[fluid].double(), frame.velocities[fluid].double(), frame.masses[fluid].double()


def make_inputs(state: FluidState, boundary: Boundary | None, scene: Scene) -> Inputs:
    """Network inputs in float32: features [1, v, ρ] (thesis section 3.1), boundary features = normals."""
    units = units_of(state.masses, scene)
    densities = state.densities[:, None] / units.density
    return _inputs(state.positions, [state.velocities / units.velocity, densities], boundary, scene.box, units)


def inputs_without_density(frame: Frame, scene: Scene) -> Inputs:
    """Network inputs in float32 without density, so that no sum over neighbours is taken: features [1, v]."""
    positions, velocities, masses = _fluid_particles(frame)
    units = units_of(masses, scene)
    return _inputs(positions, [velocities / units.velocity], frame.boundary, scene.box, units)


def _inputs(positions: Tensor, features: list[Tensor], boundary: Boundary | None, box: Box, units: Units) -> Inputs:
    corners = ([bound / units.length for bound in bounds] for bounds in (box.lower, box.upper))
    return Inputs(
        positions=(positions / units.length).float(),
        features=torch.cat([torch.ones_like(positions[:, :1]), *features], dim=1).float(),
        boundary_positions=None if boundary is None else (boundary.positions.double() / units.length).float(),
        boundary_features=None if boundary is None else _boundary_features(boundary),
        box=Box(*corners, box.periodic),
        units=units,
    )


def _boundary_features(boundary: Boundary) -> Tensor:
    if boundary.normals is None:
        return torch.ones(len(boundary.positions), 1)
    return boundary.normals.float()


@dataclass(frozen=True)
class Standardization:
    """Shift and scale: ``(value - mean) / scale``.

    Attributes:
        mean: (C,).
        scale: (C,), positive.
    """

    mean: Tensor
    scale: Tensor

    def first(self, channels: int) -> "Standardization":
        """Standardisation of the first `channels` values alone."""
        return Standardization(self.mean[:channels], self.scale[:channels])


def standardize_features(features: Iterable[Tensor], center_velocity: bool = True) -> Standardization:
    """Standardisation of features [1, v, ρ] over a training split.

    The constant stays as it is; the components of v share one scale, so that directions are kept.

    Args:
        features: Tensors (N, D + 2), one a frame.
        center_velocity: Whether the mean velocity is taken off; not for what must turn with the scene.
    """
    stacked = torch.cat([values.double() for values in features])
    one, velocity, rho = stacked[:, :1], stacked[:, 1:-1], stacked[:, -1:]
    parts = [standardize_vectors([velocity], center_velocity), standardize_vectors([rho])]
    mean = torch.cat([torch.zeros_like(one[0]), *(part.mean for part in parts)])
    scale = torch.cat([torch.ones_like(one[0]), *(part.scale for part in parts)])
    return Standardization(mean, scale)


def standardize_vectors(vectors: Iterable[Tensor], center: bool = True) -> Standardization:
    """Standardisation of vectors (N, C): mean of each component, one scale for all.

    The scale is the root of the mean variance of the components, so that the mean squared error of standardised values
    is the mean squared error divided by the variance. A constant field keeps scale 1.

    Args:
        vectors: Tensors (N, C), one a frame.
        center: Whether the mean is taken off; not for what must turn with the scene.
    """
    stacked = torch.cat([values.double() for values in vectors])
    variance = stacked.var(dim=0, correction=0).mean()
    scale = torch.where(variance > 0, variance.sqrt(), 1.0)
    mean = stacked.mean(dim=0) if center else torch.zeros_like(stacked[0])
    return Standardization(mean, scale.expand(stacked.shape[1]).clone())
