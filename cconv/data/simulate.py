"""Simulation of one trajectory of a scene with the solver, as data sets store it."""

from collections.abc import Generator
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from cconv.data.trajectory import ParticleType
from cconv.errors import SimulationError
from cconv.scenes.simulated_scene import SimulatedScene
from cconv.sph.solver import ParticleState, WeaklyCompressibleSPH

ATTEMPTS = 5  # LagrangeBench lost 15 of 115 dam breaks


@dataclass(frozen=True, kw_only=True)
class Simulation:
    """A trajectory as it is stored: fluid and the wall particles that touch it, walls first.

    Attributes:
        positions: (T, N, D), float32.
        velocities: (T, N, D), float32, length per time.
        particle_types: (N,), int64.
        masses: (N,), float32.
        viscosity: Kinematic viscosity ν.
        failures: One line for every earlier attempt that blew up.
    """

    positions: Tensor
    velocities: Tensor
    particle_types: Tensor
    masses: Tensor
    viscosity: float
    failures: tuple[str, ...]


def simulate(scene: SimulatedScene, num_frames: int, seed: int, index: int) -> Generator[None, None, Simulation]:
    """Simulate trajectory `index` of a data set; if it blows up, draw another initial state. Yields after each frame.

    Args:
        scene: Scene to compute.
        num_frames: Frames to store.
        seed: Seed of the data set; the same seed and index give the same bytes.
        index: Which trajectory.

    Returns:
        The trajectory, as the value of ``yield from``.

    Raises:
        SimulationError: If every attempt blows up.
    """
    failures: list[str] = []
    for attempt in range(ATTEMPTS):
        draw = np.random.SeedSequence([seed, index, attempt]).generate_state(1, np.uint64)[0]
        generator = torch.Generator().manual_seed(int(draw >> 1))
        try:
            return (yield from _run(scene, num_frames, generator, tuple(failures)))
        except SimulationError as error:
            failures.append(f"trajectory {index}, start {attempt + 1}: {error}")
    raise SimulationError(f"All {ATTEMPTS} starts of trajectory {index} blew up; the last: {failures[-1]}")


def _run(
    scene: SimulatedScene, num_frames: int, generator: torch.Generator, failures: tuple[str, ...]
) -> Generator[None, None, Simulation]:
    walls, solver, state = scene.walls, scene.solver(), scene.initial_state(generator)
    stored = torch.cat([walls.stored, torch.ones(len(state.positions) - len(walls), dtype=torch.bool)])
    positions = torch.empty(num_frames, int(stored.sum()), scene.dim)
    velocities = torch.empty_like(positions)
    for frame in range(-scene.skipped_frames, num_frames):
        if frame >= 0:
            # Rounding to float32 may reach the upper edge: wrap once more.
            positions[frame] = scene.box.wrap(state.positions[stored].float())
            velocities[frame] = state.velocities[stored].float()
        if frame < num_frames - 1:
            state = next_frame(scene, solver, state)
        yield
    moving = walls.velocities.any(dim=1)[walls.stored]
    types = torch.full((len(stored[stored]),), int(ParticleType.FLUID))
    types[: len(moving)] = torch.where(moving, int(ParticleType.MOVING_WALL), int(ParticleType.SOLID_WALL))
    return Simulation(
        positions=positions,
        velocities=velocities,
        particle_types=types,
        masses=state.masses[stored].float(),
        viscosity=float(state.viscosities[0]),
        failures=failures,
    )


def next_frame(scene: SimulatedScene, solver: WeaklyCompressibleSPH, state: ParticleState) -> ParticleState:
    """State a stored frame later.

    Raises:
        SimulationError: If the simulation blew up.
    """
    for _ in range(scene.steps_per_frame):
        state = solver.step(state, scene.time_step)
    _check_speed(state, scene)
    return state


def _check_speed(state: ParticleState, scene: SimulatedScene) -> None:
    fastest, sound_speed = float(state.velocities.norm(dim=1).max()), scene.equation_of_state.sound_speed
    if not fastest < sound_speed:
        raise SimulationError(
            f"The simulation blew up by step {state.steps}: a particle moves at {fastest:.3g}, faster than sound "
            f"({sound_speed:.3g}); take a smaller time step or more particles."
        )
