"""Checks of the fluid of a trajectory: each finds one kind of implausible data, and says what to do about it.

`cconv.data.plausibility` makes findings of them, with the names of trajectory, frame and particle.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import torch
from scipy.spatial import cKDTree
from torch import Tensor

from cconv.data.quantities import MOST_NEIGHBORS, density_deviation, mean_neighbors
from cconv.data.source import STORED
from cconv.data.splits import evenly_spaced
from cconv.data.trajectory import ParticleType, Scene, Trajectory
from cconv.sph.kernels import QuinticSpline

FRAMES_WITH_NEIGHBORS = 5  # in which nearest neighbours are looked for, evenly spaced over a trajectory
SPACING_RANGE = (0.5, 1.5)  # median distance of nearest neighbours, in particle spacings
SAME_PLACE = 1e-3  # distance of particles that count as one, in particle spacings
LARGEST_SPEED = 25  # in mean speeds of a trajectory
VELOCITY_RANGE = (0.5, 2.0)  # length of steps, in lengths that velocities say
FAR_AWAY = 20  # distance from the middle of the fluid, in distances that nine of ten particles keep
AT_REST = 1e-4  # length of a step, in particle spacings
USUAL_CUTOFF = 2  # of networks, in particle spacings
MANY_NEIGHBORS = 1000  # within the usual cutoff, beyond which the spacing is wrong
HALF = 0.5  # share of the fluid particles
DENSITY_RANGE = (0.7, 1.4)  # number density of the fluid, in that of a lattice of the particle spacing
LARGEST_DENSITY = 2.0  # of a particle, in that at rest
JUMP = 4  # length of a step, in lengths that the faster of the velocities at its ends says
FEW = 8  # particles, of which neither densities nor equal frames tell anything


@dataclass(frozen=True)
class Seen:
    """What a check found.

    Attributes:
        frame: Frame, counted from the first one that was looked at.
        particle: Number of the particle among the fluid ones; None if it concerns all.
        text: What is wrong, and what to do.
        stops: Whether nothing can be learned from such data.
    """

    frame: int
    particle: int | None
    text: str
    stops: bool = False


class Fluid:
    """The fluid particles of a trajectory, as the checks look at them.

    Args:
        trajectory: The trajectory, or a piece of it.
        scene: Its scene.
        fluid: Numbers of the fluid particles among all stored ones, (N,).

    Attributes:
        positions: (T, N, D), length.
        velocities: (T, N, D), length per time.
        steps: Minimum-image displacements from frame to frame, (T - 1, N, D), length.
        speeds: (T, N), length per time.
        masses: (N,).
        numbers: Numbers of the fluid particles among all stored ones, (N,).
    """

    def __init__(self, trajectory: Trajectory, scene: Scene, fluid: Tensor):
        self.trajectory, self.scene, self.numbers = trajectory, scene, fluid
        self.positions = trajectory.positions[:, fluid]
        self.velocities = trajectory.velocities[:, fluid]
        self.steps = scene.box.displacement(self.positions[1:], self.positions[:-1])
        self.speeds = torch.linalg.vector_norm(self.velocities, dim=-1)
        self.masses = trajectory.masses[fluid]

    @property
    def open_axes(self) -> list[int]:
        """Axes that are not periodic."""
        return [axis for axis, wraps in enumerate(self.scene.box.periodic) if not wraps]

    @cached_property
    def nearest(self) -> dict[int, tuple[np.ndarray, np.ndarray]]:
        """Distances to the nearest other particle, and its number, each (N,), by frame; empty for a single particle."""
        frames = evenly_spaced(len(self.positions), FRAMES_WITH_NEIGHBORS) if len(self.numbers) > 1 else ()
        return {frame: self._nearest_in(frame) for frame in frames}

    @cached_property
    def densities(self) -> dict[int, Tensor]:
        """Sums of kernels over all particles times dx^D, by frame; 1 on a lattice. Empty where they cannot be."""
        scene, particles = self.scene, self.trajectory
        reach = QuinticSpline(scene.particle_spacing, scene.dim).support_radius
        if len(self.numbers) < FEW or scene.box.shortest_period < 2 * reach:
            return {}
        stored = particles.particle_types != ParticleType.PAD
        found = {}
        for frame in self.nearest:
            if mean_neighbors(self.positions[frame], reach) > MOST_NEIGHBORS:
                continue
            chosen = replace(particles[frame], positions=scene.box.wrap(particles[frame].positions[stored]))
            alike = replace(chosen, masses=torch.ones(int(stored.sum()), dtype=torch.float64))
            is_fluid = particles.particle_types[stored] == ParticleType.FLUID
            found[frame] = density_deviation(alike, scene)[is_fluid] + 1
        return found

    def _nearest_in(self, frame: int) -> tuple[np.ndarray, np.ndarray]:
        """Distance of each fluid particle to the nearest other particle, fluid or wall, and that one's number, (N,)."""
        stored = (self.trajectory.particle_types != ParticleType.PAD).nonzero()[:, 0]
        box, positions = self.scene.box, self.trajectory.positions[frame, stored].double()
        lower = torch.tensor([low if wraps else 0.0 for low, wraps in zip(box.lower, box.periodic, strict=True)])
        lengths = [length if wraps else 0.0 for length, wraps in zip(box.lengths, box.periodic, strict=True)]
        tree = cKDTree((box.wrap(positions) - lower).numpy(), boxsize=lengths)
        distances, numbers = tree.query((box.wrap(self.positions[frame].double()) - lower).numpy(), k=2)
        numbers = stored.numpy()[numbers]
        itself = numbers[:, 1] == self.numbers.numpy()  # of particles at the same place, either may come first
        return distances[:, 1], np.where(itself, numbers[:, 0], numbers[:, 1])


def _first(where: Tensor) -> tuple[int, int, int] | None:
    """Frame and particle of the first true value of (T, N), and how many are true in that frame; None if none is."""
    if not where.any():
        return None
    frame = int(where.any(dim=1).int().argmax())
    return frame, int(where[frame].int().argmax()), int(where[frame].sum())


def _first_beyond(values: Tensor, limit: float, text: str) -> Seen | None:
    """The first of values (T, N) beyond a limit; `text` may name the "{value}" and the "{count}" in its frame."""
    if (first := _first(values > limit)) is None:
        return None
    frame, particle, count = first
    return Seen(frame, particle, text.format(value=f"{float(values[frame, particle]):.3g}", count=count))


def _masses(fluid: Fluid) -> Seen | None:
    if (first := _first(~(fluid.masses > 0)[None])) is None:
        return None
    frame, particle, count = first
    mass = float(fluid.masses[particle])
    return Seen(frame, particle, f"mass {mass:g} is not positive ({count} fluid particles); give --mass")


def _zeros(fluid: Fluid) -> Seen | None:
    zero = (fluid.positions == 0).flatten(1).all(dim=1)
    if len(fluid.numbers) < 2 or not zero.any():
        return None
    text = f"all positions are zero, in {int(zero.sum())} frames: they were never written; cut the trajectory before"
    return Seen(int(zero.int().argmax()), None, text, stops=bool(zero[0]))


def _frozen(fluid: Fluid) -> Seen | None:
    frame_dt, spacing = fluid.scene.frame_dt, fluid.scene.particle_spacing
    still = (fluid.steps == 0).flatten(1).all(dim=1)
    frozen = still & (fluid.speeds[1:].amax(dim=1) * frame_dt > AT_REST * spacing)
    if not frozen.any():
        return None
    text = "all positions are those of the frame before, although particles move; drop repeated frames"
    return Seen(int(frozen.int().argmax()) + 1, None, text)


def _outside(fluid: Fluid) -> Seen | None:
    """Particles that left the box through an open axis; where there are no walls, those that are far from it."""
    box, spacing, axes = fluid.scene.box, fluid.scene.particle_spacing, fluid.open_axes
    if not axes:
        return None
    lower, upper = (torch.tensor(bounds)[axes] for bounds in (box.lower, box.upper))
    positions = fluid.positions[..., axes]
    beyond = torch.maximum(lower - positions, positions - upper).amax(dim=-1)
    return _first_beyond(
        beyond / spacing,
        1.0 if fluid.scene.has_boundary else max(box.lengths) / spacing,
        "it is {value} particle spacings outside the box ({count} fluid particles are); correct `bounds`, or drop what "
        "has left the scene",
    )


def _far(fluid: Fluid) -> Seen | None:
    """Particles far from all others on open axes, as the box of data without bounds holds them by definition."""
    if not fluid.open_axes:
        return None
    positions = fluid.positions[..., fluid.open_axes]
    distances = torch.linalg.vector_norm(positions - positions.median(dim=1, keepdim=True).values, dim=-1)
    nine_of_ten = math.ceil(0.9 * distances.shape[1])
    usual = distances.kthvalue(nine_of_ten, dim=1, keepdim=True).values.clamp(min=fluid.scene.particle_spacing)
    return _first_beyond(
        distances / usual,
        FAR_AWAY,
        "it is {value} times as far from the middle of the fluid as nine of ten particles ({count} fluid particles are "
        f"beyond {FAR_AWAY}); the simulation lost it: drop it, or cut the trajectory before",
    )


def _crossing(fluid: Fluid) -> Seen | None:
    for axis in fluid.open_axes:
        name = "xyz"[axis]
        seen = _first_beyond(
            fluid.steps[..., axis].abs(),
            fluid.scene.box.lengths[axis] / 2,
            f"it moves {{value}} along {name} from the frame before, more than half of the box ({{count}} fluid "
            f"particles do), although {name} is not periodic; correct `periodic_boundary_conditions`",
        )
        if seen is not None:
            return replace(seen, frame=seen.frame + 1)  # a step leads to the next frame
    return None


def _speeds(fluid: Fluid) -> Seen | None:
    return _first_beyond(
        fluid.speeds / fluid.speeds.mean(dtype=torch.float64),
        LARGEST_SPEED,
        "its speed is {value} times the mean of the trajectory ({count} fluid particles are beyond "
        f"{LARGEST_SPEED}); look at this frame, and cut the trajectory before if it blew up",
    )


def _velocities(fluid: Fluid) -> Seen | None:
    """Stored velocities in other units than length per time, or another time between frames."""
    if fluid.scene.velocity_source != STORED or len(fluid.steps) == 0:
        return None
    said = (fluid.velocities[1:] + fluid.velocities[:-1]) / 2 * fluid.scene.frame_dt
    moved, expected = (float(values.double().norm()) for values in (fluid.steps, said))
    smallest = AT_REST * fluid.scene.particle_spacing * np.sqrt(fluid.steps[..., 0].numel())
    ratio = moved / expected if expected > 0 else np.inf
    low, high = VELOCITY_RANGE
    if max(moved, expected) <= smallest or low <= ratio <= high:
        return None
    text = (
        f"particles move {ratio:.3g} times as far from frame to frame as their velocities say; give --frame-dt, or "
        "store velocities as length per time"
    )
    return Seen(0, None, text)


def _spacing(fluid: Fluid) -> Seen | None:
    spacing = fluid.scene.particle_spacing
    low, high = SPACING_RANGE
    medians = {frame: float(np.median(distances)) for frame, (distances, _) in fluid.nearest.items()}
    for frame in (0, len(fluid.positions) - 1):
        if frame in medians and not low * spacing <= medians[frame] <= high * spacing:
            text = (
                f"half of the particles have their nearest neighbour within {medians[frame]:.3g}, which does not fit a "
                f"particle spacing of {spacing:g}; give --particle-spacing"
            )
            return Seen(frame, None, text)
    return None


def _neighbors(fluid: Fluid) -> Seen | None:
    """No neighbours within the usual cutoff, or a thousand: the spacing is of other units than the positions."""
    cutoff = USUAL_CUTOFF * fluid.scene.particle_spacing
    for frame, (distances, _) in fluid.nearest.items():
        lonely = distances > cutoff
        if lonely.mean() > HALF:
            text = (
                f"{lonely.mean():.0%} of the fluid particles have no neighbour within {cutoff:.3g}, "
                f"{USUAL_CUTOFF} particle spacings; give --particle-spacing (about {np.median(distances):.3g})"
            )
            return Seen(frame, int(lonely.argmax()), text, stops=True)
        mean = mean_neighbors(fluid.positions[frame], cutoff)
        if mean > MANY_NEIGHBORS:
            text = (
                f"fluid particles have about {mean:.0f} neighbours within {cutoff:.3g}, {USUAL_CUTOFF} particle "
                f"spacings; give --particle-spacing (about {np.median(distances):.3g})"
            )
            return Seen(frame, None, text, stops=True)
    return None


def _number_density(fluid: Fluid) -> Seen | None:
    """Particles packed otherwise than the spacing says; a free surface and thin walls lower the sums beside them."""
    low, high = DENSITY_RANGE
    for frame, densities in fluid.densities.items():
        middle, inner = (float(densities.quantile(share)) for share in (0.5, 0.9))
        if middle > high or inner < low:
            packed = middle if middle > high else inner
            fits = fluid.scene.particle_spacing * packed ** (-1 / fluid.scene.dim)
            text = (
                f"the fluid is {packed:.3g} times as dense as its particle spacing {fluid.scene.particle_spacing:g} "
                f"says; give --particle-spacing {fits:.3g}, unless the simulation compresses it so"
            )
            return Seen(frame, None, text)
    return None


def _compressed(fluid: Fluid) -> Seen | None:
    """Particles far denser than at rest, in data whose spacing fits."""
    if _number_density(fluid) is not None:
        return None
    for frame, densities in fluid.densities.items():
        seen = _first_beyond(
            densities[None],
            LARGEST_DENSITY,
            "the density there is {value} times that at rest ({count} fluid particles are beyond "
            f"{LARGEST_DENSITY:g}); the simulation clumps or blew up: look at this frame",
        )
        if seen is not None:
            return replace(seen, frame=frame)
    return None


def _jumps(fluid: Fluid) -> Seen | None:
    """Steps beyond a spacing that stored velocities do not explain: another order of particles, or an explosion."""
    if fluid.scene.velocity_source != STORED or len(fluid.steps) == 0:
        return None
    said = torch.maximum(fluid.speeds[1:], fluid.speeds[:-1]) * fluid.scene.frame_dt
    moved = torch.linalg.vector_norm(fluid.steps, dim=-1)
    if (moved > JUMP * said).double().mean() > HALF:
        return None  # velocities of other units, or none, which are no jumps
    seen = _first_beyond(
        moved / torch.maximum(JUMP * said, torch.full_like(said, fluid.scene.particle_spacing)),
        1.0,
        "it jumps {value} times as far from the frame before as its velocity and the particle spacing allow ({count} "
        "fluid particles do); sort particles by their ids, correct `bounds`, or cut the trajectory before",
    )
    return None if seen is None else replace(seen, frame=seen.frame + 1)


def _duplicates(fluid: Fluid) -> Seen | None:
    for frame, (distances, others) in fluid.nearest.items():
        same = distances <= SAME_PLACE * min(fluid.scene.particle_spacing, float(np.median(distances)))
        if same.any():
            particle = int(same.argmax())
            text = (
                f"particle {others[particle]} is at the same place ({int(same.sum())} fluid particles share theirs); "
                "drop copies, or mind that the simulation lets particles merge"
            )
            return Seen(frame, particle, text, stops=bool(same.mean() > HALF))
    return None


CHECKS: dict[str, Callable[[Fluid], Seen | None]] = {
    "masses": _masses,
    "zeros": _zeros,
    "frozen": _frozen,
    "outside": _outside,
    "far": _far,
    "crossing": _crossing,
    "jumps": _jumps,
    "speeds": _speeds,
    "velocities": _velocities,
    "spacing": _spacing,
    "neighbors": _neighbors,
    "number_density": _number_density,
    "compressed": _compressed,
    "duplicates": _duplicates,
}
