"""What a network is given: features of fluid particles and boundary points, and their standardisation."""

from collections.abc import Iterable
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from cconv.data.trajectory import Boundary, Frame, ParticleType
from cconv.domain import Box
from cconv.neighbors import Edges, radius_graph
from cconv.sph.operators import density


@dataclass(frozen=True, kw_only=True)
class Inputs:
    """The fluid particles of a frame as a network sees them.

    Attributes:
        positions: Fluid positions (N, D), length.
        features: [1, v, ρ] of each fluid particle, (N, D + 2), or [1, v], (N, D + 1), in the units of the data.
        boundary_positions: (B, D), or None where the scene has no boundary.
        boundary_features: Normals (B, D), or ones (B, 1) where the data hold none; None without boundary.
        box: Bounds and periodic axes.
    """

    positions: Tensor
    features: Tensor
    boundary_positions: Tensor | None
    boundary_features: Tensor | None
    box: Box

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


def make_inputs(state: FluidState, boundary: Boundary | None, box: Box) -> Inputs:
    """Network inputs in float32: features [1, v, ρ] (thesis section 3.1), boundary features = normals."""
    return _inputs(state.positions, [state.velocities, state.densities[:, None]], boundary, box)


def inputs_without_density(frame: Frame, box: Box) -> Inputs:
    """Network inputs in float32 without density, so that no sum over neighbours is taken: features [1, v]."""
    positions, velocities, _ = _fluid_particles(frame)
    return _inputs(positions, [velocities], frame.boundary, box)


def _inputs(positions: Tensor, features: list[Tensor], boundary: Boundary | None, box: Box) -> Inputs:
    return Inputs(
        positions=positions.float(),
        features=torch.cat([torch.ones_like(positions[:, :1]), *features], dim=1).float(),
        boundary_positions=None if boundary is None else boundary.positions.float(),
        boundary_features=None if boundary is None else _boundary_features(boundary),
        box=box,
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
