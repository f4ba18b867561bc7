"""Plausibility of particle data: find data that can be read but do not look like a simulation of a fluid.

Readers refuse damaged files. This module reports what is only suspicious: each finding names the first trajectory,
frame and particle with the problem, and what to do.
"""

import hashlib
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, dataclass, replace

from cconv.data.dataset import Dataset
from cconv.data.fluid_checks import CHECKS, FEW, Fluid
from cconv.data.stored_frames import StoredFrames
from cconv.data.trajectory import ParticleType, Scene, Trajectory
from cconv.errors import DataError


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
    view = Fluid(trajectory, scene, fluid)
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
