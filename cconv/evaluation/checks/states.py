"""Perturbed states of a frame in which models fail, e.g. denser, faster, clumped or rotated."""

import itertools
import math
from collections.abc import Iterator
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from cconv.data.trajectory import Boundary, Frame, ParticleType, Scene
from cconv.domain import Box
from cconv.neighbors import Edges, radius_graph
from cconv.sph.kernels import AbstractKernel

AS_IT_IS, FAR_AWAY = "as_it_is", "far_away"
CLUMPED_AT = (0.05, 0.1, 0.15, 0.19)  # distances of clumped pairs, particle spacings
APPROACH = 3.0  # what a clumped pair adds to the rate of density, in typical rates
FAR = 1000.0  # particle spacings that a frame is moved by
ISOLATED = 6  # particles that lose their neighbours
SQUEEZED, SQUEEZED_WITHIN = 3, 4.0  # clumps of fluid, and their radius before, particle spacings


@dataclass(frozen=True, kw_only=True)
class State:
    """A frame in some state, unchanged or perturbed.

    Attributes:
        name: Name of the state.
        frame: Particles.
        scene: Their scene; its box moves with them.
        affected: Fluid particles whose errors count, (N,), bool; None for all.
    """

    name: str
    frame: Frame
    scene: Scene
    affected: Tensor | None = None


def stressed_states(
    frame: Frame,
    scene: Scene,
    kernel: AbstractKernel,
    *,
    typical_rate: float,
    fastest: float,
    reach: float,
    seed: int,
) -> list[State]:
    """Make the unchanged frame, and the frame in the states in which models fail.

    Denser and sparser by shares of the number density; half and double spacing of the same particles; stretched and
    compressed along the first and the last axis; clumped pairs, squeezed clumps, isolated particles and pairs; rotated,
    tilted (in open space), mirrored, reversed; ten and a hundred times as fast as the fastest; in a frame of reference
    that moves, and far from the origin. A state whose periodic box would be too narrow to search is left out.

    Args:
        frame: Particles at one time.
        scene: Their scene.
        kernel: SPH kernel, which says how fast clumped pairs must approach to matter.
        typical_rate: Rate of density that is usual in the data.
        fastest: Largest speed in the data.
        reach: Largest distance that anything searches.
        seed: Seed of the choice of particles.
    """
    generator = torch.Generator().manual_seed(seed)
    states = [
        State(name=AS_IT_IS, frame=frame, scene=scene),
        _clumped(frame, scene, kernel, typical_rate, generator),
        _squeezed(frame, scene, generator),
        _isolated(frame, scene, generator),
        *_scaled_states(frame, scene),
        *_turned_states(frame, scene),
        State(name="reversed", frame=replace(frame, velocities=-frame.velocities), scene=scene),
        *_faster_states(frame, scene, fastest),
        _in_a_moving_frame(frame, scene, fastest),
        _far_away(frame, scene),
    ]
    return [state for state in states if _can_be_searched(state.scene.box, reach)]


def oblique(dim: int) -> Tensor:
    """A unit vector along no axis."""
    direction = torch.arange(1, dim + 1, dtype=torch.float64)
    return direction / direction.norm()


def _can_be_searched(box: Box, reach: float) -> bool:
    return all(length >= 2 * reach for length, wraps in zip(box.lengths, box.periodic, strict=True) if wraps)


def _scaled_states(frame: Frame, scene: Scene) -> Iterator[State]:
    densities = {"half_density": 0.5, "forty_percent_denser": 1.4, "twice_as_dense": 2.0}
    factors = {name: torch.full((scene.dim,), density ** (-1 / scene.dim)) for name, density in densities.items()}
    factors |= {"half_spacing": torch.full((scene.dim,), 0.5), "double_spacing": torch.full((scene.dim,), 2.0)}
    for suffix, axis in {"": 0, "_across": scene.dim - 1}.items():
        factors |= {
            f"stretched{suffix}": _along(scene.dim, axis, 1.3),
            f"compressed{suffix}": _along(scene.dim, axis, 0.7),
        }
    for name, factor in factors.items():
        if not (scene.dim == 1 and name.endswith("across")):
            yield _moved(name, frame, scene, torch.diag(factor.double()), torch.eye(scene.dim).double())


def _along(dim: int, axis: int, factor: float) -> Tensor:
    factors = torch.ones(dim)
    factors[axis] = factor
    return factors


def _turned_states(frame: Frame, scene: Scene) -> Iterator[State]:
    mirror = torch.diag(_along(scene.dim, 0, -1.0).double())
    yield _moved("mirrored", frame, scene, mirror, mirror)
    angles = {"turned": math.pi / 2} | ({} if any(scene.box.periodic) else {"tilted": math.pi / 6})
    for first in range(scene.dim - 1):
        for name, angle in angles.items():
            turn = torch.eye(scene.dim, dtype=torch.float64)
            cosine, sine = round(math.cos(angle), 15), math.sin(angle)
            turn[first : first + 2, first : first + 2] = torch.tensor([[cosine, -sine], [sine, cosine]])
            yield _moved(name if first == 0 else f"{name}_across", frame, scene, turn, turn)


def _faster_states(frame: Frame, scene: Scene, fastest: float) -> Iterator[State]:
    own = float(frame.velocities.double().norm(dim=1).max())
    for name, factor in {"ten_times_as_fast": 10.0, "hundred_times_as_fast": 100.0}.items():
        if own > 0:
            yield State(
                name=name, frame=replace(frame, velocities=frame.velocities * (factor * fastest / own)), scene=scene
            )


def _in_a_moving_frame(frame: Frame, scene: Scene, fastest: float) -> State:
    """Add a constant velocity of ten times the largest speed to all velocities (a Galilean boost)."""
    passing = (10 * fastest * oblique(scene.dim)).to(frame.velocities.dtype)
    return State(name="moving_frame", frame=replace(frame, velocities=frame.velocities + passing), scene=scene)


def _far_away(frame: Frame, scene: Scene) -> State:
    """Move the scene by a thousand particle spacings along each axis."""
    shift = FAR * scene.particle_spacing
    box = Box([low + shift for low in scene.box.lower], [high + shift for high in scene.box.upper], scene.box.periodic)
    boundary = frame.boundary
    if boundary is not None:
        boundary = replace(boundary, positions=boundary.positions + shift)
    moved = replace(frame, positions=frame.positions + shift, boundary=boundary)
    return State(name=FAR_AWAY, frame=moved, scene=replace(scene, box=box))


def _moved(name: str, frame: Frame, scene: Scene, matrix: Tensor, of_vectors: Tensor) -> State:
    """Map the points and the box of a frame by a matrix (D, D), and its vectors by another."""
    box = _mapped_box(scene.box, matrix)

    def mapped(points: Tensor, by: Tensor) -> Tensor:
        return (points.double() @ by.T).to(points.dtype)

    boundary = frame.boundary
    if boundary is not None:
        normals = None if boundary.normals is None else mapped(boundary.normals, of_vectors)
        boundary = Boundary(positions=mapped(boundary.positions, matrix), normals=normals)
    positions, velocities = box.wrap(mapped(frame.positions, matrix)), mapped(frame.velocities, of_vectors)
    moved = replace(frame, positions=positions, velocities=velocities, boundary=boundary)
    return State(name=name, frame=moved, scene=replace(scene, box=box))


def _mapped_box(box: Box, matrix: Tensor) -> Box:
    """The box around the mapped corners; periodic axes map to axes."""
    corners = torch.tensor(list(itertools.product(*zip(box.lower, box.upper, strict=True))), dtype=torch.float64)
    mapped = corners @ matrix.T
    periodic = (matrix.abs() @ torch.tensor(box.periodic, dtype=torch.float64) > 0).tolist()
    return Box(mapped.amin(dim=0).tolist(), mapped.amax(dim=0).tolist(), periodic)


def _clumped(
    frame: Frame, scene: Scene, kernel: AbstractKernel, typical_rate: float, generator: torch.Generator
) -> State:
    """Put one fluid particle in twenty close to its nearest neighbour, and let the two approach or separate.

    Their relative speed is so large that the pair dominates the rate of density of both particles. So an error of the
    pair is an error of the particles.
    """
    fluid = (frame.particle_types == ParticleType.FLUID).nonzero()[:, 0]
    positions, velocities = frame.positions.double().clone(), frame.velocities.double().clone()
    edges = radius_graph(positions[fluid], 2 * scene.particle_spacing, scene.box)
    affected = torch.zeros(len(fluid), dtype=torch.bool)
    for number, (particle, nearest, direction) in enumerate(_nearest_pairs(edges, len(fluid), generator)):
        distance = CLUMPED_AT[number % len(CLUMPED_AT)] * scene.particle_spacing
        moved, partner = fluid[particle], fluid[nearest]
        positions[moved] = positions[partner] + distance * direction
        slope = float(kernel.derivative(torch.tensor(distance, dtype=torch.float64)).abs() * frame.masses[partner])
        approach = (-1) ** number * APPROACH * typical_rate / slope if slope > 0 else 0.0
        middle = (velocities[moved] + velocities[partner]) / 2
        velocities[moved], velocities[partner] = middle + approach / 2 * direction, middle - approach / 2 * direction
        affected[[particle, nearest]] = True
    clumped = replace(
        frame,
        positions=scene.box.wrap(positions).to(frame.positions.dtype),
        velocities=velocities.to(frame.velocities.dtype),
    )
    return State(name="clumped", frame=clumped, scene=scene, affected=affected)


def _nearest_pairs(edges: Edges, particles: int, generator: torch.Generator) -> Iterator[tuple[int, int, Tensor]]:
    """Choose particles, each with its nearest neighbour and the direction from it; no particle is in two pairs."""
    taken: set[int] = set()
    for particle in torch.randperm(particles, generator=generator)[: max(4, particles // 20)].tolist():
        row = slice(int(edges.row_splits[particle]), int(edges.row_splits[particle + 1]))
        if row.start == row.stop:
            continue
        place = row.start + int(edges.distances[row].argmin())
        nearest = int(edges.senders[place])
        if not taken & {particle, nearest} and edges.distances[place] > 0:
            taken |= {particle, nearest}
            yield particle, nearest, edges.displacements[place] / edges.distances[place]


def _squeezed(frame: Frame, scene: Scene, generator: torch.Generator) -> State:
    """Contract the fluid around some particles, most at the centre, where lengths shrink to 0.7."""
    fluid = (frame.particle_types == ParticleType.FLUID).nonzero()[:, 0]
    positions = frame.positions.double().clone()
    radius = SQUEEZED_WITHIN * scene.particle_spacing
    affected = torch.zeros(len(fluid), dtype=torch.bool)
    for center in positions[fluid[torch.randperm(len(fluid), generator=generator)[:SQUEEZED]]]:
        from_center = scene.box.displacement(positions[fluid], center)
        share = from_center.norm(dim=1, keepdim=True) / radius
        moved = center + from_center * (0.7 + 0.3 * share)
        positions[fluid] = torch.where(share < 1, moved, positions[fluid])
        affected |= share[:, 0] < 0.6
    squeezed = replace(frame, positions=scene.box.wrap(positions).to(frame.positions.dtype))
    return State(name="squeezed", frame=squeezed, scene=scene, affected=affected)


def _isolated(frame: Frame, scene: Scene, generator: torch.Generator) -> State:
    """Remove all neighbours, or all but one, of some fluid particles within four spacings."""
    fluid = (frame.particle_types == ParticleType.FLUID).nonzero()[:, 0]
    chosen = torch.randperm(len(fluid), generator=generator)[:ISOLATED]
    edges = radius_graph(frame.positions[fluid].double(), 4 * scene.particle_spacing, _fitting(scene, 4.0))
    lost, affected = torch.zeros(len(fluid), dtype=torch.bool), torch.zeros(len(fluid), dtype=torch.bool)
    for number, particle in enumerate(chosen.tolist()):
        senders = edges.senders[edges.row_splits[particle] : edges.row_splits[particle + 1]]
        lost[senders[number % 2 :]] = True
        affected[particle] = True
    lost[chosen] = False
    keep = torch.ones(len(frame.positions), dtype=torch.bool)
    keep[fluid[lost]] = False
    isolated = replace(
        frame,
        positions=frame.positions[keep],
        velocities=frame.velocities[keep],
        masses=frame.masses[keep],
        particle_types=frame.particle_types[keep],
    )
    return State(name="isolated", frame=isolated, scene=scene, affected=affected[~lost])


def _fitting(scene: Scene, spacings: float) -> Box:
    """Open the axes of the scene's box that are too narrow for a neighbour search over so many spacings."""
    reach = 2 * spacings * scene.particle_spacing
    periodic = tuple(
        wraps and length >= reach for wraps, length in zip(scene.box.periodic, scene.box.lengths, strict=True)
    )
    return Box(scene.box.lower, scene.box.upper, periodic)
