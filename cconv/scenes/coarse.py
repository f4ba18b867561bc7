"""The solver run coarser, the cheap alternative to a model: fewer particles, slower sound, larger steps."""

import math
from collections.abc import Iterator
from dataclasses import replace

import torch
from torch import Tensor

from cconv.errors import ConfigError
from cconv.neighbors import radius_graph
from cconv.scenes.simulated_scene import SimulatedScene
from cconv.scenes.walls import lattice
from cconv.sph.kernels import QuinticSpline
from cconv.sph.operators import density, interpolate
from cconv.sph.solver import ParticleState

FACTORS = (1.5, 2.0, 3.0, 4.0, 6.0)  # by which scenes are made coarser, as nearly as their lengths allow
SLOW_SOUND = 5.0  # speed of sound ÷ reference speed; densities deviate four times as much as with the usual 10
FILLED = 0.5  # share of the rest density above which a place counts as one in the fluid


def coarser(scene: SimulatedScene, factor: float, sound_ratio: float | None = None) -> SimulatedScene:
    """The scene with particles farther apart, and as few steps from frame to frame as the CFL conditions allow.

    Its frames lie at the same times; two dimensions and a factor of 2 cost about an eighth.

    Args:
        scene: The scene to compare with.
        factor: By which the particle spacing grows.
        sound_ratio: Speed of sound ÷ reference speed; None for that of the scene.

    Raises:
        ConfigError: If the factor is not positive, or the solver cannot fill the scene with such particles.
    """
    if not 0 < factor < math.inf:
        raise ConfigError(f"`factor` must be positive, got {factor}.")
    spaced = replace(
        scene,
        particle_spacing=factor * scene.particle_spacing,
        sound_ratio=scene.sound_ratio if sound_ratio is None else sound_ratio,
        time_step=math.inf,
    )
    steps = math.ceil(scene.frame_dt / spaced.time_step * (1 - 1e-9))
    coarse = replace(spaced, steps_per_frame=steps, time_step=scene.frame_dt / steps)
    coarse.solver()
    return coarse


def with_slow_sound(scene: SimulatedScene) -> SimulatedScene | None:
    """The scene with a lower speed of sound, and so fewer steps in a frame; None where other limits set the step."""
    slow = coarser(scene, 1, SLOW_SOUND)
    return slow if slow.steps_per_frame < coarser(scene, 1).steps_per_frame else None


def coarser_scenes(scene: SimulatedScene) -> Iterator[SimulatedScene]:
    """Yield the scene at coarser and coarser spacings that divide its shortest length, as far as the solver can go."""
    shortest = min(_lengths(scene))
    cells = round(shortest / scene.particle_spacing)
    for fewer in dict.fromkeys(round(cells / factor) for factor in FACTORS):
        try:
            coarse = coarser(scene, shortest / (max(fewer, 1) * scene.particle_spacing))
            len(coarse.walls)  # a wall may not fit
        except ConfigError:
            return
        yield coarse


def coarse_state(scene: SimulatedScene, coarse: SimulatedScene, state: ParticleState) -> ParticleState:
    """Begin a coarse flow from a state of the finer scene: a lattice where its fluid is, with its velocities.

    Args:
        scene: The finer scene.
        coarse: The same scene, coarser.
        state: Particles of the finer scene.
    """
    counts = [round(length / coarse.particle_spacing) for length in _lengths(scene)]
    places = lattice(counts, coarse.particle_spacing, scene.corner)
    fluid = ~state.is_wall
    kernel = QuinticSpline(scene.particle_spacing, scene.dim)
    edges = radius_graph(state.positions[fluid], kernel.support_radius, scene.box, queries=places)
    places = places[density(state.masses[fluid], edges, kernel) > FILLED * scene.rest_density]
    velocities = _velocities(places, state, kernel, scene)
    positions = coarse.box.wrap(places + _shift(scene, coarse))
    return coarse.state_of(coarse.walls, positions, velocities, float(state.viscosities[0]), amid_flow=True)


def velocities_at(points: Tensor, scene: SimulatedScene, coarse: SimulatedScene, state: ParticleState) -> Tensor:
    """Velocities (N, D) of a coarse flow at points of a finer scene, by Shepard-normalised SPH interpolation.

    Points are taken relative to the corner of the space for fluid, as thicker walls move the coarse one. Where there
    is no fluid within the kernel's reach, the velocity is zero.

    Args:
        points: Positions (N, D) in the finer scene.
        scene: The finer scene.
        coarse: The scene of the state, from `coarser`.
        state: Its particles.
    """
    places = coarse.box.wrap(points.double() + _shift(scene, coarse))
    return _velocities(places, state, QuinticSpline(coarse.particle_spacing, coarse.dim), coarse)


def _velocities(places: Tensor, state: ParticleState, kernel: QuinticSpline, scene: SimulatedScene) -> Tensor:
    """Velocities (M, D) of the fluid of a state at places (M, D) of its scene; zero where none is in reach."""
    fluid = ~state.is_wall
    edges = radius_graph(state.positions[fluid], kernel.support_radius, scene.box, queries=places)
    volumes = state.masses[fluid] / state.densities[fluid]
    return torch.nan_to_num(interpolate(state.velocities[fluid], volumes, edges, kernel), nan=0.0)


def _shift(scene: SimulatedScene, coarse: SimulatedScene) -> Tensor:
    """What leads from a place of the scene to the same place of the coarse one, (D,): its walls are thicker."""
    return torch.tensor(coarse.corner, dtype=torch.float64) - torch.tensor(scene.corner, dtype=torch.float64)


def _lengths(scene: SimulatedScene) -> list[float]:
    """Edge lengths of the space within the walls."""
    corner = zip(scene.box.lengths, scene.corner, scene.box.lower, strict=True)
    return [length - 2 * (inner - outer) for length, inner, outer in corner]
