"""Restarts of the solver from stored frames, with the walls in full: data sets hold only what touches the fluid."""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import torch
from scipy.spatial import cKDTree
from torch import Tensor

from cconv.data.simulate import next_frame
from cconv.data.trajectory import finite_difference_velocities
from cconv.data.window import Window
from cconv.errors import DataError
from cconv.neighbors import radius_graph
from cconv.scenes.simulated_scene import SimulatedScene
from cconv.scenes.walls import Walls
from cconv.sph.solver import ParticleState


@dataclass(frozen=True, kw_only=True)
class Restart:
    """A state of the solver that continues a stored frame.

    Attributes:
        state: All wall particles of the scene, then the fluid in the order of the frame.
        places: Index in the state of each particle of the frame, (N,), int64.
    """

    state: ParticleState
    places: Tensor


def solved_frames(scene: SimulatedScene, start: Window, velocities: Tensor | None = None) -> Iterator[Window]:
    """Yield the windows after a start, a frame later each, as the solver computes them; a rollout without a model.

    Args:
        scene: The scene of the window, see `restart`.
        start: The window to begin with.
        velocities: Velocities of its particles at the present (N, D), or None.

    Raises:
        SimulationError: If the simulation blows up.
    """
    begun, solver = restart(scene, start, velocities), scene.solver()
    state, window = begun.state, replace(start, positions=start.positions.double())
    while True:
        state = next_frame(scene, solver, state)
        window = window.followed_by(state.positions[begun.places])
        yield window


def restart(scene: SimulatedScene, start: Window, velocities: Tensor | None = None) -> Restart:
    """Set up the solver at the present of a window.

    Densities that the solver evolves are not stored, and a wrong pressure sends waves through the fluid. They are
    carried along by the solver from frame to frame of the window, each with the positions that are stored.

    Args:
        scene: The scene of the window, with the viscosity of its trajectory.
        start: The window; its walls are those that the scene stores, in any order.
        velocities: Velocities of its particles at the present (N, D), length per time; None for differences of its
            frames, of which there must be two.

    Raises:
        DataError: If the walls are not those of the scene.
        ConfigError: If a particle lies outside the box of the scene.
        ShapeError: If there are neither velocities nor differences.
        SimulationError: If the simulation of the window's frames blows up.
    """
    path = finite_difference_velocities(start.positions.double(), scene.frame_dt, scene.box)
    path[-1] = _velocities_now(start, scene) if velocities is None else velocities
    begun = _begun(scene, start, start.present, path[-1])
    if scene.density_scheme == "summation" or len(path) == 1:
        return begun
    solver, state = scene.solver(), _begun(scene, start, start.positions[0], path[0]).state
    for positions, velocity in zip(start.positions[1:], path[1:], strict=True):
        state = next_frame(scene, solver, state)
        begun = _begun(scene, start, positions, velocity)
        state = replace(begun.state, densities=state.densities)
    return replace(begun, state=state)


def _begun(scene: SimulatedScene, window: Window, positions: Tensor, velocities: Tensor) -> Restart:
    """The solver at a frame of a window, with densities summed from its positions (N, D)."""
    fluid, positions = window.is_fluid, positions.double()
    walls, places_of_walls = _full_walls(scene, positions[~fluid])
    places = torch.empty(len(fluid), dtype=torch.long)
    places[~fluid] = places_of_walls
    places[fluid] = len(walls) + torch.arange(int(fluid.sum()))
    state = scene.state_of(walls, positions[fluid], velocities[fluid], scene.viscosity, amid_flow=True)
    return Restart(state=state, places=places)


def _velocities_now(start: Window, scene: SimulatedScene) -> Tensor:
    """Velocities (N, D) at the present from the frames up to it, of second order in time if there are three."""
    last = start.last_displacements(scene.box)
    before = start.displacements(scene.box, 3)[0] if len(start.positions) > 2 else last
    return (1.5 * last - 0.5 * before) / scene.frame_dt


def _full_walls(scene: SimulatedScene, stored: Tensor) -> tuple[Walls, Tensor]:
    """Walls of the scene with the stored particles (S, D) in place, and which of the walls' particles these are (S,).

    What is not stored keeps its place relative to the nearest particle that is: walls of LagrangeBench's dam break are
    a third of a spacing off ours.

    Raises:
        DataError: If stored particles and those that the scene stores do not belong to each other one by one.
    """
    walls, kept = scene.walls, scene.walls.stored.nonzero()[:, 0]
    if len(kept) != len(stored):
        raise DataError(f"the frame has {len(stored)} wall particles, and {scene.name} stores {len(kept)} at its size.")
    if len(kept) == 0:
        return walls, kept
    moved = scene.box.wrap(walls.positions + _time_moved(scene, stored) * walls.velocities)
    pairs = radius_graph(moved[kept], 0.5 * scene.particle_spacing, scene.box, queries=stored)
    if any(len(each.unique()) < len(kept) for each in (pairs.receivers, pairs.senders)) or len(pairs) > len(kept):
        raise DataError(f"the wall particles of the frame do not lie where {scene.name} has its own at this size.")
    offsets = torch.empty_like(stored)
    offsets[pairs.senders] = pairs.displacements
    nearest = cKDTree(moved[kept].numpy()).query(moved.numpy())[1]
    return replace(walls, positions=scene.box.wrap(moved + offsets[nearest])), kept[pairs.senders]


def _time_moved(scene: SimulatedScene, stored: Tensor) -> float:
    """A time after which walls stand where stored particles (S, D) do; 0 if none moves.

    A wall that moves is a lattice that slides along itself, so that it is enough to look at its nearest particle.
    """
    walls = scene.walls
    moving = walls.velocities.any(dim=1) & walls.stored
    if not moving.any():
        return 0.0
    offsets = scene.box.displacement(stored[:, None], walls.positions[moving])
    nearest = int(offsets.norm(dim=2).argmin())
    velocity = walls.velocities[moving][nearest % int(moving.sum())]
    return float(offsets.flatten(0, 1)[nearest] @ velocity / velocity.square().sum())
