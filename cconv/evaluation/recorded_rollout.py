"""A rollout from a stored window, with its time per frame, kept as far as it came."""

import math
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from cconv.data.dataset import Dataset
from cconv.data.hdf5 import write_dataset
from cconv.data.trajectory import Scene, Trajectory, finite_difference_velocities
from cconv.data.window import Window
from cconv.evaluation.rollout_comparison import check_masses, rollout_metrics
from cconv.models.model import Model
from cconv.rollout.rollout import Diverged, rollout

DIFFERENCES = "central differences of positions"
LENGTHS = (1, 5, 10, 20, 50, 100, 200, 400)  # frames n of MSE_n, as in LagrangeBench
MOST_SINKHORN = 4  # frames: one takes seconds
WARM_UP = 2  # frames at the start whose time does not count


@dataclass(frozen=True, kw_only=True)
class RecordedRollout:
    """The frames of a rollout as far as it came, and those that are stored for the same times.

    Attributes:
        start: Window that it began with.
        positions: Frames after the start, (T, N, D).
        milliseconds: Time of each, (T,).
        ended: Why it ended before its last frame; None if it did not.
    """

    start: Window
    positions: Tensor
    milliseconds: np.ndarray
    ended: str | None

    @property
    def reference(self) -> Tensor:
        """Stored frames of the same times, (T, N, D)."""
        return self.start.future[: len(self.positions)]

    @property
    def milliseconds_per_frame(self) -> float:
        """Median time of a frame after the first ones."""
        return float(np.median(self.milliseconds[WARM_UP:] if len(self.milliseconds) > WARM_UP else self.milliseconds))


def record_rollout(
    model: Model, start: Window, scene: Scene, progress: Callable[[Iterable, str], Iterable] = lambda items, _: items
) -> RecordedRollout:
    """Roll a model out for as many frames as are stored after a window; Ctrl-C keeps the frames so far.

    Raises:
        DataError: If the fluid has no mass, without which the rollout could not be measured.
    """
    check_masses(start.masses, start.is_fluid)
    frames: list[Tensor] = []
    times: list[float] = []
    ended = None
    path = rollout(model, start, scene)
    try:
        for _ in progress(range(len(start.future)), "rollout"):
            before = time.perf_counter()
            frames.append(next(path).present)
            times.append(1e3 * (time.perf_counter() - before))
    except Diverged as error:
        ended = f"diverged: {error.reason}"
    except KeyboardInterrupt:
        ended = "interrupted"
    return RecordedRollout(
        start=start,
        positions=torch.stack(frames) if frames else start.future[:0],
        milliseconds=np.array(times),
        ended=ended,
    )


def rollout_facts(recorded: RecordedRollout, scene: Scene, stride: int = 10) -> dict:
    """Measures of a rollout of at least one frame, by the names of LagrangeBench's and Neural SPH's metrics.

    Args:
        recorded: The rollout.
        scene: Its scene.
        stride: Frames from one that is looked at to the next, at most; squared errors are of every frame, and Sinkhorn
            divergences of at most `MOST_SINKHORN`.
    """
    last, start = recorded.start.present[None].double(), recorded.start
    count = len(recorded.positions)
    stride = min(stride, count)
    metrics = rollout_metrics(
        torch.cat([last, recorded.positions.double()]),
        torch.cat([last, recorded.reference.double()]),
        start.masses,
        start.is_fluid,
        scene,
        stride=stride,
        sinkhorn_stride=math.ceil(count // stride / MOST_SINKHORN),
    )
    return {
        "frames": count,
        "ended": recorded.ended,
        "milliseconds_per_frame": recorded.milliseconds_per_frame,
        "mse_n": {str(n): float(metrics.mse[:n].mean()) for n in sorted({*LENGTHS, count}) if n <= count},
        "metrics": metrics.as_dict(),
    }


def trajectories_of(recorded: RecordedRollout, scene: Scene) -> dict[str, Trajectory]:
    """The stored frames and those of the rollout as trajectories that begin with the same window."""
    past = recorded.start.positions
    return {
        "reference": _trajectory(recorded, torch.cat([past, recorded.reference]), scene),
        "rollout": _trajectory(recorded, torch.cat([past, recorded.positions.to(past.dtype)]), scene),
    }


def _trajectory(recorded: RecordedRollout, positions: Tensor, scene: Scene) -> Trajectory:
    start = recorded.start
    return Trajectory(
        name=start.trajectory,
        first_frame=start.frame - len(start.positions) + 1,
        positions=positions,
        velocities=finite_difference_velocities(positions, scene.frame_dt, scene.box),
        masses=start.masses,
        particle_types=start.particle_types,
        boundary=start.boundary,
    )


def write_rollout(folder: Path, recorded: RecordedRollout, dataset: Dataset) -> None:
    """Write a rollout in the LagrangeBench layout: the rollout is the test split, the stored frames are the others.

    Raises:
        ConfigError: If the folder exists and is not empty, or cannot be written.
    """
    scene = replace(dataset.scene, velocity_source=DIFFERENCES)
    both = trajectories_of(recorded, scene)
    splits = {"train": [both["reference"]], "valid": [both["reference"]], "test": [both["rollout"]]}
    write_dataset(folder, scene, splits, dataset.metadata)
