"""Plausibility of particle data: find data that can be read but do not look like a simulation of a fluid.

Readers refuse damaged files. This module reports what is only suspicious: each finding names the first trajectory,
frame and particle with the problem, and what to do.
"""

import hashlib
import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, dataclass, replace
from functools import cached_property

import numpy as np
import torch
from scipy.spatial import cKDTree
from torch import Tensor

from cconv.data.dataset import Dataset
from cconv.data.quantities import density_deviation
from cconv.data.source import STORED
from cconv.data.splits import evenly_spaced
from cconv.data.stored_frames import StoredFrames
from cconv.data.trajectory import ParticleType, Scene, Trajectory
from cconv.errors import DataError
from cconv.sph.kernels import QuinticSpline

FRAMES_WITH_NEIGHBORS = 5  # in which nearest neighbours are looked for, evenly spaced over a trajectory
SPACING_RANGE = (0.5, 1.5)  # median distance of nearest neighbours, in particle spacings
SAME_PLACE = 1e-3  # distance of particles that count as one, in particle spacings
LARGEST_SPEED = 25  # in mean speeds of a trajectory
VELOCITY_RANGE = (0.5, 2.0)  # length of steps, in lengths that velocities say
FAR_AWAY = 20  # distance from the middle of the fluid, in distances that nine of ten particles keep
AT_REST = 1e-4  # length of a step, in particle spacings
USUAL_CUTOFF = 2  # of networks, in particle spacings
MOST_NEIGHBORS = 2000  # that are counted for a particle; usual are 10 to 60
PARTICLES_COUNTED = 1000  # for a mean number of neighbours
MANY_NEIGHBORS = 1000  # within the usual cutoff, beyond which the spacing is wrong
HALF = 0.5  # share of the fluid particles
DENSITY_RANGE = (0.7, 1.4)  # number density of the fluid, in that of a lattice of the particle spacing
LARGEST_DENSITY = 2.0  # of a particle, in that at rest
JUMP = 4  # length of a step, in lengths that the faster of the velocities at its ends says
FEW = 8  # particles, of which neither densities nor equal frames tell anything


@dataclass(frozen=True, kw_only=True)
class DataFinding:
    """An implausibility in a trajectory.

    Attributes:
        check: Name of the check that found it.
        trajectory: Name of the first trajectory with the problem.
        frame: Stored number of the first frame with the problem.
        particle: Stored number of a particle with the problem; None if it concerns all.
        text: The problem and what to do.
        stops: Whether nothing can be learned from such data, so that a study refuses them.
        others: Number of other trajectories, or blocks of one, with the problem.
    """

    check: str
    trajectory: str
    frame: int
    particle: int | None
    text: str
    stops: bool = False
    others: int = 0

    def __str__(self) -> str:
        particle = "" if self.particle is None else f", particle {self.particle}"
        others = f" (and {self.others} more trajectories or blocks)" if self.others else ""
        return f"trajectory {self.trajectory}, frame {self.frame}{particle}: {self.text}{others}"

    def as_dict(self) -> dict:
        """Plain values for JSON, with the whole line as "line"."""
        return asdict(self) | {"line": str(self)}


def dataset_findings(
    dataset: Dataset,
    progress: Callable[[Iterable, str], Iterable] = lambda items, _: items,
    splits: Sequence[str] | None = None,
) -> list[DataFinding]:
    """Find the implausibilities of a data set; every trajectory of its splits is read, long ones piece by piece.

    Args:
        dataset: The data set.
        progress: Wraps the blocks of the splits to show progress, given a label.
        splits: Names of the splits; None for all.

    Raises:
        DataError: If the data are damaged.
    """
    blocks = [(split, k) for split in splits or dataset.splits for k in range(len(dataset.splits[split]))]
    shared, found = SharedFrames(), []
    for split, k in progress(blocks, "check data"):
        for piece in StoredFrames(dataset, split, k).pieces():
            found += [*trajectory_findings(piece, dataset.scene), *shared.findings(split, piece)]
    return first_of_each(found)


def first_of_each(findings: Sequence[DataFinding]) -> list[DataFinding]:
    """The first finding of each check, what stops before others, with the number of other trajectories that have it."""
    counts: dict[str, list[DataFinding]] = {}
    for finding in sorted(findings, key=lambda finding: not finding.stops):
        counts.setdefault(finding.check, []).append(finding)
    return [replace(first, others=len({each.trajectory for each in rest})) for first, *rest in counts.values()]


def refuse_nonsense(findings: Iterable[DataFinding]) -> None:
    """Refuse data from which nothing can be learned.

    Raises:
        DataError: With the first finding that stops.
    """
    for finding in findings:
        if finding.stops:
            raise DataError(f"the data make no sense: {finding}")


class SharedFrames:
    """Finds frames that stand in two splits, where the second only seems to be new."""

    def __init__(self) -> None:
        self._seen: dict[bytes, tuple[str, str, int]] = {}

    def findings(self, split: str, trajectory: Trajectory) -> list[DataFinding]:
        """The first frame of a trajectory that another split has too, if there is one; remembers its frames."""
        for k, positions in enumerate(trajectory.positions):
            content = positions.contiguous().numpy()
            if len(content) < FEW or not content.any():
                continue
            here = split, trajectory.name, trajectory.first_frame + k
            there = self._seen.setdefault(hashlib.blake2b(content, digest_size=16).digest(), here)
            if there[0] != split:
                text = (
                    f"it is frame {there[2]} of trajectory {there[1]} in the {there[0]} split; splits must not share "
                    "frames of a run: give each run to one split"
                )
                found = DataFinding(
                    check="shared", trajectory=here[1], frame=here[2], particle=None, text=text, stops=True
                )
                return [found]
        return []


def trajectory_findings(trajectory: Trajectory, scene: Scene) -> list[DataFinding]:
    """Find the implausibilities in the fluid of a trajectory, at most one for each check."""
    fluid = (trajectory.particle_types == ParticleType.FLUID).nonzero()[:, 0]
    if len(fluid) == 0:
        return []
    view = _Fluid(trajectory, scene, fluid)
    return [
        DataFinding(
            check=check,
            trajectory=trajectory.name,
            frame=trajectory.first_frame + seen.frame,
            particle=None if seen.particle is None else int(fluid[seen.particle]),
            text=seen.text,
            stops=seen.stops,
        )
        for check, look in CHECKS.items()
        if (seen := look(view)) is not None
    ]


@dataclass(frozen=True)
class _Seen:
    """A frame, counted from the first of the trajectory, a fluid particle of it, and what is wrong."""

    frame: int
    particle: int | None
    text: str
    stops: bool = False


class _Fluid:
    """The fluid particles of a trajectory, as the checks look at them.

    Attributes:
        positions: (T, N, D).
        velocities: (T, N, D).
        steps: Minimum-image displacements from frame to frame, (T - 1, N, D).
        speeds: (T, N).
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
        """What `_nearest_in` finds, by frame, evenly spaced from the first to the last; none for a single particle."""
        frames = evenly_spaced(len(self.positions), FRAMES_WITH_NEIGHBORS) if len(self.numbers) > 1 else ()
        return {frame: self._nearest_in(frame) for frame in frames}

    @cached_property
    def densities(self) -> dict[int, Tensor]:
        """Sums of kernels over all particles times dx^D, by frame; 1 on a lattice. Empty where they cannot be."""
        scene, particles = self.scene, self.trajectory
        reach = QuinticSpline(scene.particle_spacing, scene.dim).support_radius
        wrapping = [length for length, wraps in zip(scene.box.lengths, scene.box.periodic, strict=True) if wraps]
        if len(self.numbers) < FEW or min(wrapping, default=math.inf) < 2 * reach:
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


def mean_neighbors(positions: Tensor, radius: float) -> float:
    """Mean number of particles (N, D) within a radius of one, itself included; without regard to periodic axes.

    It is that of a thousand particles, evenly spaced in storage, where there are more.
    """
    points = positions.double().numpy()
    asked = points[evenly_spaced(len(points), PARTICLES_COUNTED)]
    return float(cKDTree(points).query_ball_point(asked, radius, return_length=True).mean())


def _first(where: Tensor) -> tuple[int, int, int] | None:
    """Frame and particle of the first true value of (T, N), and how many are true in that frame; None if none is."""
    if not where.any():
        return None
    frame = int(where.any(dim=1).int().argmax())
    return frame, int(where[frame].int().argmax()), int(where[frame].sum())


def _first_beyond(values: Tensor, limit: float, text: str) -> _Seen | None:
    """The first of values (T, N) beyond a limit; `text` may name the "{value}" and the "{count}" in its frame."""
    if (first := _first(values > limit)) is None:
        return None
    frame, particle, count = first
    return _Seen(frame, particle, text.format(value=f"{float(values[frame, particle]):.3g}", count=count))


def _masses(fluid: _Fluid) -> _Seen | None:
    if (first := _first(~(fluid.masses > 0)[None])) is None:
        return None
    frame, particle, count = first
    mass = float(fluid.masses[particle])
    return _Seen(frame, particle, f"mass {mass:g} is not positive ({count} fluid particles); give --mass")


def _zeros(fluid: _Fluid) -> _Seen | None:
    zero = (fluid.positions == 0).flatten(1).all(dim=1)
    if len(fluid.numbers) < 2 or not zero.any():
        return None
    text = f"all positions are zero, in {int(zero.sum())} frames: they were never written; cut the trajectory before"
    return _Seen(int(zero.int().argmax()), None, text, stops=bool(zero[0]))


def _frozen(fluid: _Fluid) -> _Seen | None:
    frame_dt, spacing = fluid.scene.frame_dt, fluid.scene.particle_spacing
    still = (fluid.steps == 0).flatten(1).all(dim=1)
    frozen = still & (fluid.speeds[1:].amax(dim=1) * frame_dt > AT_REST * spacing)
    if not frozen.any():
        return None
    text = "all positions are those of the frame before, although particles move; drop repeated frames"
    return _Seen(int(frozen.int().argmax()) + 1, None, text)


def _outside(fluid: _Fluid) -> _Seen | None:
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


def _far(fluid: _Fluid) -> _Seen | None:
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


def _crossing(fluid: _Fluid) -> _Seen | None:
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


def _speeds(fluid: _Fluid) -> _Seen | None:
    return _first_beyond(
        fluid.speeds / fluid.speeds.mean(dtype=torch.float64),
        LARGEST_SPEED,
        "its speed is {value} times the mean of the trajectory ({count} fluid particles are beyond "
        f"{LARGEST_SPEED}); look at this frame, and cut the trajectory before if it blew up",
    )


def _velocities(fluid: _Fluid) -> _Seen | None:
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
    return _Seen(0, None, text)


def _spacing(fluid: _Fluid) -> _Seen | None:
    spacing = fluid.scene.particle_spacing
    low, high = SPACING_RANGE
    medians = {frame: float(np.median(distances)) for frame, (distances, _) in fluid.nearest.items()}
    for frame in (0, len(fluid.positions) - 1):
        if frame in medians and not low * spacing <= medians[frame] <= high * spacing:
            text = (
                f"half of the particles have their nearest neighbour within {medians[frame]:.3g}, which does not fit a "
                f"particle spacing of {spacing:g}; give --particle-spacing"
            )
            return _Seen(frame, None, text)
    return None


def _neighbors(fluid: _Fluid) -> _Seen | None:
    """No neighbours within the usual cutoff, or a thousand: the spacing is of other units than the positions."""
    cutoff = USUAL_CUTOFF * fluid.scene.particle_spacing
    for frame, (distances, _) in fluid.nearest.items():
        lonely = distances > cutoff
        if lonely.mean() > HALF:
            text = (
                f"{lonely.mean():.0%} of the fluid particles have no neighbour within {cutoff:.3g}, "
                f"{USUAL_CUTOFF} particle spacings; give --particle-spacing (about {np.median(distances):.3g})"
            )
            return _Seen(frame, int(lonely.argmax()), text, stops=True)
        mean = mean_neighbors(fluid.positions[frame], cutoff)
        if mean > MANY_NEIGHBORS:
            text = (
                f"fluid particles have {mean:.0f} neighbours within {cutoff:.3g}, {USUAL_CUTOFF} particle spacings; "
                f"give --particle-spacing (about {np.median(distances):.3g})"
            )
            return _Seen(frame, None, text, stops=True)
    return None


def _number_density(fluid: _Fluid) -> _Seen | None:
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
            return _Seen(frame, None, text)
    return None


def _compressed(fluid: _Fluid) -> _Seen | None:
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


def _jumps(fluid: _Fluid) -> _Seen | None:
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


def _duplicates(fluid: _Fluid) -> _Seen | None:
    for frame, (distances, others) in fluid.nearest.items():
        same = distances <= SAME_PLACE * min(fluid.scene.particle_spacing, float(np.median(distances)))
        if same.any():
            particle = int(same.argmax())
            text = (
                f"particle {others[particle]} is at the same place ({int(same.sum())} fluid particles share theirs); "
                "drop copies, or mind that the simulation lets particles merge"
            )
            return _Seen(frame, particle, text, stops=bool(same.mean() > HALF))
    return None


CHECKS: dict[str, Callable[[_Fluid], _Seen | None]] = {
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
