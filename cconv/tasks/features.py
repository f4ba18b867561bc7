"""Features: named scalars and vectors of fluid particles and wall points, computed from frames and windows."""

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn.functional import normalize, one_hot

from cconv.batching import counts_of
from cconv.data.trajectory import Boundary, Frame, ParticleType, Scene
from cconv.data.window import Window
from cconv.domain import Box
from cconv.neighbors import Edges, radius_graph
from cconv.nn.kinds import Kinds
from cconv.sph.compiled import compiled_sums
from cconv.sph.kernels import AbstractKernel
from cconv.sph.operators import density, velocity_gradient
from cconv.tasks.inputs import Features, Inputs, Units, spread_densities, units_of

CONSTANT, DENSITY, PARTICLE_TYPE, NORMAL = "one", "density", "particle_type", "normal"  # names of features
TYPE_ONE_HOT = "type_one_hot"
ACCELERATIONS, FORCE, VELOCITY = "accelerations", "force", "velocity"
PRESSURE_SOURCE, WALL_DISTANCE, WALL_NORMAL = "pressure_source", "wall_distance", "wall_normal"
NUM_TYPES = 9  # that LagrangeBench counts
WALLS = "walls"  # stands among the features of a task for those of the wall points


def units_of_windows(state: "FluidState", scene: Scene) -> Units:
    """Units of a state, in which each of several windows has a density of its own."""
    if state.batch_index is None or state.fluid_batch_index is None:
        return units_of(state.fluid_masses, scene)
    counts = counts_of(state.batch_index)
    fluid = counts_of(state.fluid_batch_index, len(counts))
    units = [units_of(masses, scene) for masses in state.fluid_masses.split(fluid)]
    return replace(units[0], density=spread_densities(units, state.batch_index))


def features_in(names: Sequence[str], history: int) -> tuple[str, ...]:
    """Those of some features that windows of so many frames have; two have no acceleration before the present."""
    return tuple(name for name in names if name != ACCELERATIONS or history > 2)


def kinds_of(names: Sequence[str], history: int = 1) -> Kinds:
    """How many of some features are scalars and how many vectors, in windows of some frames."""
    scalars = (NUM_TYPES if name == TYPE_ONE_HOT else 1 for name in names if name in _SCALARS)
    vectors = (history - 2 if name == ACCELERATIONS else 1 for name in names if name in _VECTORS)
    return Kinds(sum(scalars), sum(vectors))


@dataclass(frozen=True, kw_only=True)
class FluidState:
    """Fluid particles of a frame in float64, as analytic SPH sees them.

    Attributes:
        positions: (N, D).
        velocities: (N, D).
        masses: (N,).
        box: Bounds and periodic axes.
        kernel: SPH kernel of densities and fields.
        batch_index: Window that each particle belongs to, (N,), ascending, if there are several; None for one.
    """

    positions: Float[Tensor, "N D"]
    velocities: Float[Tensor, "N D"]
    masses: Float[Tensor, " N"]
    box: Box | None
    kernel: AbstractKernel
    batch_index: Int[Tensor, " N"] | None = None

    @property
    def fluid_masses(self) -> Float[Tensor, " M"]:
        """Masses of the fluid particles (M,)."""
        return self.masses

    @property
    def fluid_batch_index(self) -> Int[Tensor, " M"] | None:
        """Window that each fluid particle belongs to (M,)."""
        return self.batch_index

    @cached_property
    def edges(self) -> Edges:
        """Pairs within the kernel's support."""
        return radius_graph(self.positions, self.kernel.support_radius, self.box, batch_index=self.batch_index)

    @cached_property
    def densities(self) -> Float[Tensor, " N"]:
        """Density by summation over these particles only (D1), as in the thesis, (N,)."""
        return density(self.masses, self.edges, self.kernel)

    def knowing(self, edges: Edges, densities: Float[Tensor, " N"]) -> "FluidState":
        """The same particles with neighbours and densities (N,) that come from elsewhere."""
        state = replace(self)
        vars(state).update(edges=edges, densities=densities)
        return state


def fluid_state(frame: Frame, box: Box, kernel: AbstractKernel) -> FluidState:
    """Fluid particles of a frame; neighbours and densities are computed when they are first asked for."""
    fluid = frame.particle_types == ParticleType.FLUID
    positions, velocities, masses = (
        values[fluid].double() for values in (frame.positions, frame.velocities, frame.masses)
    )
    return FluidState(positions=positions, velocities=velocities, masses=masses, box=box, kernel=kernel)


@dataclass(frozen=True, kw_only=True)
class WindowState(FluidState):
    """Particles of all types at the end of a window, in float64; velocities are backward differences.

    Attributes:
        accelerations: Second differences of the positions ÷ Δt², newest first, (N, H - 2, D).
        particle_types: Values of `ParticleType`, (N,).
        wall_points: Points that represent the walls now (B, D); none in a scene without walls.
        forces: External acceleration at each particle (N, D), 0 in a scene without a force.
        wall_batch_index: Window that each wall point belongs to, (B,), if there are several; None for one.
    """

    accelerations: Float[Tensor, "N K D"]
    particle_types: Int[Tensor, " N"]
    wall_points: Float[Tensor, "B D"]
    forces: Float[Tensor, "N D"]
    wall_batch_index: Int[Tensor, " B"] | None = None

    @property
    def is_fluid(self) -> Bool[Tensor, " N"]:
        """Which particles are fluid, (N,)."""
        return self.particle_types == ParticleType.FLUID

    @property
    def fluid_masses(self) -> Float[Tensor, " M"]:
        """Masses of the fluid particles (M,)."""
        return self.masses[self.is_fluid]

    @property
    def fluid_batch_index(self) -> Int[Tensor, " M"] | None:
        """Window that each fluid particle belongs to (M,)."""
        return None if self.batch_index is None else self.batch_index[self.is_fluid]

    @property
    def _is_differentiated(self) -> bool:
        """Whether derivatives are asked for, or the particles are not on the CPU, which compiled sums do not know."""
        return self.positions.requires_grad or self.positions.device.type != "cpu"

    @cached_property
    def densities(self) -> Float[Tensor, " N"]:
        """Density by summation over the particles of all types (D1), (N,), to 1e-6 where it is not differentiated."""
        if self._is_differentiated:
            return density(self.masses, self.edges, self.kernel)
        return compiled_sums(self.kernel).density(self.masses, self.edges)

    @property
    def pressure_sources(self) -> Float[Tensor, " N"]:
        r"""Source of the pressure in the Poisson equation of an incompressible flow, divided by the density, (N,).

        .. math:: -\frac{\nabla^2 p}{\rho} = \frac{\partial v_a}{\partial x_b} \frac{\partial v_b}{\partial x_a}

        It is positive where the flow strains and negative where it turns. Networks whose values are scalars and vectors
        cannot form it, since it is a square of a tensor. Source: Pope, "Turbulent Flows" (2000), section 2.5.
        """
        volumes = self.masses / self.densities
        if self._is_differentiated:
            gradients = velocity_gradient(volumes, self.velocities, self.edges, self.kernel)
        else:
            gradients = compiled_sums(self.kernel).velocity_gradient(volumes, self.velocities, self.edges)
        return torch.einsum("nab,nba->n", gradients, gradients)

    @cached_property
    def wall_edges(self) -> Edges:
        """Wall points within the kernel's support of the fluid particles, which are counted among themselves."""
        return radius_graph(
            self.wall_points,
            self.kernel.support_radius,
            self.box,
            queries=self.positions[self.is_fluid],
            batch_index=self.wall_batch_index,
            query_batch_index=self.fluid_batch_index,
        )

    @cached_property
    def wall_distances(self) -> Float[Tensor, " N"]:
        """Distance to the nearest wall point ÷ support radius of the kernel, at most 1, (N,); 0 for wall particles."""
        edges = self.wall_edges
        nearest = edges.distances.new_ones(edges.num_receivers)
        nearest.scatter_reduce_(0, edges.receivers, edges.distances / edges.cutoff, "amin")
        distances = torch.zeros_like(self.masses)
        distances[self.is_fluid] = nearest
        return distances

    @property
    def wall_normals(self) -> Float[Tensor, "N D"]:
        """Direction away from the walls, of length 1 at a wall point and 0 from the support radius on, (N, D).

        It is the direction of the mean of the unit vectors from wall points, weighted by the kernel: along a flat wall
        it hardly turns from point to point, as the direction from the nearest one would. Wall particles have none.
        """
        edges = self.wall_edges
        weights = self.kernel.value(edges.distances)[:, None]
        sums = torch.zeros_like(self.positions[self.is_fluid])
        sums.index_add_(0, edges.receivers, weights * normalize(edges.displacements, dim=1))
        directions = normalize(sums, dim=1)
        normals = torch.zeros_like(self.positions)
        normals[self.is_fluid] = directions * (1 - self.wall_distances[self.is_fluid, None])
        return normals


def window_state(
    window: Window, history: int, boundary: Boundary | None, scene: Scene, kernel: AbstractKernel
) -> WindowState:
    """Particles at the end of a window, and what its last `history` frames say of their motion.

    Args:
        window: The window.
        history: Frames up to the present.
        boundary: Wall points; None where the particles that are not fluid are the walls.
        scene: Scene of the window.
        kernel: SPH kernel.

    Raises:
        ShapeError: If the window has fewer frames.
    """
    velocities = window.displacements(scene.box, history) / scene.frame_dt
    positions, index = window.present.double(), window.batch_index
    of_solids = None if index is None else index[~window.is_fluid]
    return WindowState(
        positions=positions,
        velocities=velocities[-1],
        masses=window.masses.double(),
        box=scene.box,
        kernel=kernel,
        accelerations=(velocities.diff(dim=0) / scene.frame_dt).flip(0).transpose(0, 1),
        particle_types=window.particle_types,
        wall_points=positions[~window.is_fluid] if boundary is None else boundary.positions.double(),
        forces=torch.zeros_like(positions) if scene.force is None else scene.force(positions),
        batch_index=index,
        wall_batch_index=of_solids if boundary is None else boundary.batch_index,
    )


# The velocity is the last of the vectors: networks that know it only as differences leave out the last.
_SCALARS: dict[str, Callable[[Any], Tensor]] = {  # (N,) or (N, S) of a state, in the units of the data
    CONSTANT: lambda state: torch.ones_like(state.masses),
    DENSITY: lambda state: state.densities,
    PRESSURE_SOURCE: lambda state: state.pressure_sources,
    PARTICLE_TYPE: lambda state: (~state.is_fluid).double(),
    WALL_DISTANCE: lambda state: state.wall_distances,
    TYPE_ONE_HOT: lambda state: one_hot(state.particle_types.clamp(0, NUM_TYPES - 1), NUM_TYPES).double(),
}
_VECTORS: dict[str, Callable[[Any], Tensor]] = {  # (N, V, D) of a state, in the units of the data
    ACCELERATIONS: lambda state: state.accelerations,
    FORCE: lambda state: state.forces[:, None],
    WALL_NORMAL: lambda state: state.wall_normals[:, None],
    VELOCITY: lambda state: state.velocities[:, None],
}
_UNITS: dict[str, Callable[[Units], float | Tensor]] = {  # of those features that have one
    DENSITY: lambda units: units.density,
    PRESSURE_SOURCE: lambda units: units.time**-2,
    ACCELERATIONS: lambda units: units.acceleration,
    FORCE: lambda units: units.acceleration,
    VELOCITY: lambda units: units.velocity,
}


def feature_unit(name: str, units: Units) -> float | Tensor:
    """What a network takes multiples of as a feature, in the units of the data; 1 for a feature without a unit."""
    return _UNITS[name](units) if name in _UNITS else 1.0


def ordered_columns(names: Collection[str], history: int, dim: int) -> tuple[str, ...]:
    """Name of the feature that each column of `Features.flat` belongs to, of features of a frame or window.

    Args:
        names: Features of the particles.
        history: Frames of the windows.
        dim: Number of space dimensions D.
    """
    ordered = [name for name in (*_SCALARS, *_VECTORS) if name in names]
    return tuple(name for name in ordered for _ in range(kinds_of([name], history).num_values(dim)))


def make_inputs(state: FluidState, boundary: Boundary | None, scene: Scene, names: Collection[str]) -> Inputs:
    """Network inputs in float32: features of the particles by name (thesis section 3.1), normals of the walls.

    Args:
        state: Particles.
        boundary: Wall points, or None.
        scene: Scene of the frame.
        names: Features of the particles; no sum over neighbours is taken for those that are not named.
    """
    units = units_of_windows(state, scene)
    lower, upper = (
        [bound / scene.particle_spacing for bound in bounds] for bounds in (scene.box.lower, scene.box.upper)
    )
    return Inputs(
        positions=(state.positions / units.length).float(),
        features=_particle_features(state, units, names),
        wall_positions=None if boundary is None else (boundary.positions.double() / units.length).float(),
        wall_features=None if boundary is None else _wall_features(boundary),
        box=Box(lower, upper, scene.box.periodic),
        units=units,
        batch_index=state.batch_index,
        wall_batch_index=None if boundary is None else boundary.batch_index,
    )


def _particle_features(state: FluidState, units: Units, names: Collection[str]) -> Features:
    scalars = {name: feature(state) for name, feature in _SCALARS.items() if name in names}
    columns = {name: each.reshape(len(each), -1) / feature_unit(name, units) for name, each in scalars.items()}
    vectors = {name: _VECTORS[name](state) / feature_unit(name, units) for name in _VECTORS if name in names}
    return Features(
        scalars=torch.cat([*columns.values()], dim=1).float(),
        vectors=torch.cat([*vectors.values()], dim=1).float(),
        scalar_names=tuple(name for name, values in columns.items() for _ in range(values.shape[1])),
        vector_names=tuple(name for name, values in vectors.items() for _ in range(values.shape[1])),
    )


def _wall_features(boundary: Boundary) -> Features:
    positions, (points, dim) = boundary.positions, boundary.positions.shape
    if boundary.normals is None:
        ones, none = positions.new_ones(points, 1).float(), positions.new_zeros(points, 0, dim).float()
        return Features(scalars=ones, vectors=none, scalar_names=(CONSTANT,), vector_names=())
    normals = boundary.normals.float()[:, None, :]
    return Features(scalars=normals.new_zeros(points, 0), vectors=normals, scalar_names=(), vector_names=(NORMAL,))
