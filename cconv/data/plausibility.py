"""Whether particle data make sense: what can be read and still is no simulation of a fluid.

Files that cannot be what they claim are refused by their readers. Here is what is only suspicious: each finding names
the trajectory, the frame and the particle that show it first, and what to do.
"""

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass

import numpy as np
import torch
from scipy.spatial import cKDTree
from torch import Tensor

from cconv.data.dataset import Dataset
from cconv.data.source import STORED
from cconv.data.splits import evenly_spaced
from cconv.data.trajectory import ParticleType, Scene, Trajectory

FRAMES_WITH_NEIGHBORS = 5  # in which nearest neighbours are looked for, evenly spaced over a trajectory
SPACING_RANGE = (0.5, 1.5)  # median distance of nearest neighbours, in particle spacings
SAME_PLACE = 1e-3  # distance of particles that count as one, in particle spacings
LARGEST_SPEED = 25  # in mean speeds of a trajectory
VELOCITY_RANGE = (0.5, 2.0)  # length of steps, in lengths that velocities say
FAR_AWAY = 20  # distance from the middle of the fluid, in distances that nine of ten particles keep
AT_REST = 1e-4  # length of a step, in particle spacings


@dataclass(frozen=True, kw_only=True)
class DataFinding:
    """Something in a trajectory that does not make sense.

    Attributes:
        check: Name of the check that found it.
        trajectory: Name of the trajectory that shows it first.
        frame: Stored number of the frame that shows it first.
        particle: Stored number of a particle that shows it; None where it holds for all.
        text: What was found and what to do.
        others: How many other trajectories, or blocks of one, show it.
    """

    check: str
    trajectory: str
    frame: int
    particle: int | None
    text: str
    others: int = 0

    def __str__(self) -> str:
        particle = "" if self.particle is None else f", particle {self.particle}"
        others = f" (and {self.others} more trajectories or blocks)" if self.others else ""
        return f"trajectory {self.trajectory}, frame {self.frame}{particle}: {self.text}{others}"

    def as_dict(self) -> dict:
        """Plain values for JSON, with the whole line as "line"."""
        return asdict(self) | {"line": str(self)}


def dataset_findings(
    dataset: Dataset, progress: Callable[[Iterable, str], Iterable] = lambda items, _: items
) -> list[DataFinding]:
    """What does not make sense in a data set; every trajectory of every split is read, one at a time.

    Args:
        dataset: What to look at.
        progress: Wraps the blocks of all splits to show progress, given a label.

    Raises:
        DataError: If the data are damaged.
    """
    blocks = [(split, k) for split, members in dataset.splits.items() for k in range(len(members))]
    found = (trajectory_findings(dataset.trajectory(*block), dataset.scene) for block in progress(blocks, "check data"))
    return first_of_each([finding for findings in found for finding in findings])


def first_of_each(findings: Sequence[DataFinding]) -> list[DataFinding]:
    """The first finding of each check, with the number of other trajectories that have it too."""
    counts: dict[str, list[DataFinding]] = {}
    for finding in findings:
        counts.setdefault(finding.check, []).append(finding)
    return [DataFinding(**asdict(first) | {"others": len(rest)}) for first, *rest in counts.values()]


def trajectory_findings(trajectory: Trajectory, scene: Scene) -> list[DataFinding]:
    """What does not make sense in the fluid of a trajectory, at most one finding a check."""
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
        )
        for check, look in CHECKS.items()
        if (seen := next(look(view), None)) is not None
    ]


@dataclass(frozen=True)
class _Seen:
    """A frame, counted from the first of the trajectory, a fluid particle of it, and what is wrong."""

    frame: int
    particle: int | None
    text: str


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

    def nearest(self, frame: int) -> tuple[np.ndarray, np.ndarray]:
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


def _masses(fluid: _Fluid) -> Iterator[_Seen]:
    if first := _first(~(fluid.masses > 0)[None]):
        _, particle, count = first
        mass = float(fluid.masses[particle])
        yield _Seen(0, particle, f"mass {mass:g} is not positive ({count} fluid particles); give --mass")


def _zeros(fluid: _Fluid) -> Iterator[_Seen]:
    zero = (fluid.positions == 0).flatten(1).all(dim=1)
    if fluid.positions.shape[1] > 1 and zero.any():
        yield _Seen(
            int(zero.int().argmax()),
            None,
            f"all positions are zero, in {int(zero.sum())} frames: they were never written; cut the trajectory before",
        )


def _frozen(fluid: _Fluid) -> Iterator[_Seen]:
    frame_dt, spacing = fluid.scene.frame_dt, fluid.scene.particle_spacing
    still = (fluid.steps == 0).flatten(1).all(dim=1)
    moving = fluid.speeds[1:].amax(dim=1) * frame_dt > AT_REST * spacing
    if (still & moving).any():
        frame = int((still & moving).int().argmax())
        yield _Seen(
            frame + 1,
            None,
            "all positions are those of the frame before, although particles move; drop repeated frames",
        )


def _outside(fluid: _Fluid) -> Iterator[_Seen]:
    box, spacing = fluid.scene.box, fluid.scene.particle_spacing
    open_axes = [axis for axis, wraps in enumerate(box.periodic) if not wraps]
    lower, upper = (torch.tensor(bounds)[open_axes] for bounds in (box.lower, box.upper))
    positions = fluid.positions[..., open_axes]
    beyond = torch.maximum(lower - positions, positions - upper)
    margin = (
        spacing if fluid.scene.has_boundary else max(box.lengths)
    )  # without walls, a fluid may leave where it began
    if first := _first((beyond > margin).any(dim=-1)):
        frame, particle, count = first
        distance = float(beyond[frame, particle].max()) / spacing
        yield _Seen(
            frame,
            particle,
            f"it is {distance:.3g} particle spacings outside the box ({count} fluid particles are); correct `bounds`, "
            "or drop what has left the scene",
        )


def _far(fluid: _Fluid) -> Iterator[_Seen]:
    """Particles far from all others on open axes, as the box of data without bounds holds them by definition."""
    open_axes = [axis for axis, wraps in enumerate(fluid.scene.box.periodic) if not wraps]
    positions = fluid.positions[..., open_axes]
    if not open_axes:
        return
    distances = torch.linalg.vector_norm(positions - positions.median(dim=1, keepdim=True).values, dim=-1)
    nine_of_ten = math.ceil(0.9 * distances.shape[1])
    usual = distances.kthvalue(nine_of_ten, dim=1, keepdim=True).values.clamp(min=fluid.scene.particle_spacing)
    if first := _first(distances > FAR_AWAY * usual):
        frame, particle, count = first
        times = float(distances[frame, particle] / usual[frame])
        yield _Seen(
            frame,
            particle,
            f"it is {times:.3g} times as far from the middle of the fluid as nine of ten particles ({count} fluid "
            f"particles are beyond {FAR_AWAY}); the simulation lost it: drop it, or cut the trajectory before",
        )


def _crossing(fluid: _Fluid) -> Iterator[_Seen]:
    box = fluid.scene.box
    for axis, (length, wraps) in enumerate(zip(box.lengths, box.periodic, strict=True)):
        if wraps:
            continue
        steps = fluid.steps[..., axis].abs()
        if first := _first(steps > length / 2):
            frame, particle, count = first
            step = float(steps[frame, particle])
            yield _Seen(
                frame + 1,
                particle,
                f"it moves {step:.3g} along {'xyz'[axis]} from the frame before, more than half of the box ({count} "
                f"fluid particles do), although {'xyz'[axis]} is not periodic; correct `periodic_boundary_conditions`",
            )


def _speeds(fluid: _Fluid) -> Iterator[_Seen]:
    mean = float(fluid.speeds.mean(dtype=torch.float64))
    if first := _first(fluid.speeds > LARGEST_SPEED * mean):
        frame, particle, count = first
        times = float(fluid.speeds[frame, particle]) / mean
        yield _Seen(
            frame,
            particle,
            f"its speed is {times:.3g} times the mean of the trajectory ({count} fluid particles are beyond "
            f"{LARGEST_SPEED}); look at this frame, and cut the trajectory before if it blew up",
        )


def _velocities(fluid: _Fluid) -> Iterator[_Seen]:
    """Stored velocities in other units than length per time, or another time between frames."""
    if fluid.scene.velocity_source != STORED or len(fluid.steps) == 0:
        return
    said = (fluid.velocities[1:] + fluid.velocities[:-1]) / 2 * fluid.scene.frame_dt
    moved, expected = (float(values.double().norm()) for values in (fluid.steps, said))
    smallest = AT_REST * fluid.scene.particle_spacing * np.sqrt(fluid.steps[..., 0].numel())
    if max(moved, expected) <= smallest:
        return
    ratio = moved / expected if expected > 0 else np.inf
    low, high = VELOCITY_RANGE
    if not low <= ratio <= high:
        yield _Seen(
            0,
            None,
            f"particles move {ratio:.3g} times as far from frame to frame as their velocities say; give --frame-dt, or "
            "store velocities as length per time",
        )


def _spacing(fluid: _Fluid) -> Iterator[_Seen]:
    low, high = SPACING_RANGE
    spacing = fluid.scene.particle_spacing
    for frame in (0, len(fluid.positions) - 1) if fluid.positions.shape[1] > 1 else ():
        distance = float(np.median(fluid.nearest(frame)[0]))
        if not low * spacing <= distance <= high * spacing:
            yield _Seen(
                frame,
                None,
                f"half of the particles have their nearest neighbour within {distance:.3g}, which does not fit a "
                f"particle spacing of {spacing:g}; give --particle-spacing",
            )


def _duplicates(fluid: _Fluid) -> Iterator[_Seen]:
    if fluid.positions.shape[1] < 2:
        return
    for frame in evenly_spaced(len(fluid.positions), FRAMES_WITH_NEIGHBORS):
        distances, others = fluid.nearest(frame)
        same = distances <= SAME_PLACE * min(fluid.scene.particle_spacing, float(np.median(distances)))
        if same.any():
            particle = int(same.argmax())
            yield _Seen(
                frame,
                particle,
                f"particle {others[particle]} is at the same place ({int(same.sum())} fluid particles share theirs); "
                "drop copies, or mind that the simulation lets particles merge",
            )


CHECKS: dict[str, Callable[[_Fluid], Iterator[_Seen]]] = {
    "masses": _masses,
    "zeros": _zeros,
    "frozen": _frozen,
    "outside": _outside,
    "far": _far,
    "crossing": _crossing,
    "speeds": _speeds,
    "velocities": _velocities,
    "spacing": _spacing,
    "duplicates": _duplicates,
}
