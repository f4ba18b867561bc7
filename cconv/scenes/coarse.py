"""The solver run coarser, the cheap alternative to a model: fewer particles, larger steps, the same flow."""

import math
from dataclasses import replace

import torch
from torch import Tensor

from cconv.errors import ConfigError
from cconv.neighbors import radius_graph
from cconv.scenes.simulated_scene import SimulatedScene
from cconv.sph.kernels import QuinticSpline
from cconv.sph.operators import interpolate
from cconv.sph.solver import ParticleState


def coarser(scene: SimulatedScene, factor: float) -> SimulatedScene:
    """The scene with particles farther apart, and as few steps from frame to frame as the CFL conditions allow.

    Its frames lie at the same times; two dimensions and a factor of 2 cost about an eighth.

    Args:
        scene: The scene to compare with.
        factor: By which the particle spacing grows.

    Raises:
        ConfigError: If the factor is not positive, or the solver cannot fill the scene with such particles.
    """
    if not 0 < factor < math.inf:
        raise ConfigError(f"`factor` must be positive, got {factor}.")
    spaced = replace(scene, particle_spacing=factor * scene.particle_spacing, time_step=math.inf)
    steps = math.ceil(scene.frame_dt / spaced.time_step * (1 - 1e-9))
    coarse = replace(spaced, steps_per_frame=steps, time_step=scene.frame_dt / steps)
    coarse.solver()
    return coarse


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
    shift = torch.tensor(coarse.corner, dtype=torch.float64) - torch.tensor(scene.corner, dtype=torch.float64)
    kernel, fluid = QuinticSpline(coarse.particle_spacing, coarse.dim), ~state.is_wall
    places = coarse.box.wrap(points.double() + shift)
    edges = radius_graph(state.positions[fluid], kernel.support_radius, coarse.box, queries=places)
    volumes = state.masses[fluid] / state.densities[fluid]
    return torch.nan_to_num(interpolate(state.velocities[fluid], volumes, edges, kernel), nan=0.0)
