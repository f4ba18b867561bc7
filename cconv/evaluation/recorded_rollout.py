"""A rollout beside the stored frames, measured as it goes and handed on frame by frame; none of it stays in memory."""

import itertools
import math
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from torch import Tensor

from cconv.data.growing import growing_dataset
from cconv.data.metadata import DIFFERENCES
from cconv.data.stored_frames import StoredFrames
from cconv.data.trajectory import Scene, Trajectory
from cconv.data.window import Window, check_window, window_at
from cconv.devices import wait_for
from cconv.evaluation.rollout_comparison import RolloutMeter, RolloutMetrics, check_masses, speed_edges
from cconv.models.model import Model
from cconv.rollout.correctors import Corrector
from cconv.rollout.rollout import Diverged, rollout
from cconv.tasks.task import StepTask

LENGTHS = (1, 5, 10, 20, 50, 100, 200, 400)  # frames n of MSE_n, as in LagrangeBench
STRIDE = 10  # frames from one that is looked at to the next
MOST_SINKHORN = 4  # frames: one takes seconds
WARM_UP = 2  # frames at the start whose time does not count

Keep = Callable[[Tensor, Tensor], None]


@dataclass(frozen=True, kw_only=True)
class RecordedRollout:
    """What was measured of a rollout, as far as it came.

    Attributes:
        start: Window that it began with.
        frames: Number of frames after the start.
        milliseconds: Time of each, (frames,).
        metrics: Metrics of the frames.
        ended: Why it ended before its last frame; None if it did not.
    """

    start: Window
    frames: int
    milliseconds: np.ndarray
    metrics: RolloutMetrics
    ended: str | None

    @property
    def milliseconds_per_frame(self) -> float:
        """Median time of a frame after the first ones."""
        return float(np.median(self.milliseconds[WARM_UP:] if self.frames > WARM_UP else self.milliseconds))


@dataclass(frozen=True, kw_only=True)
class Asked:
    """A rollout to record.

    Attributes:
        begun: The frames that it begins with.
        stored: Gives the stored frames (N, D) after them, one after another, each time it is called.
        frames: Number of these frames.
        scene: Scene of the frames.
        stride: Frames from one that all metrics look at to the next; squared errors are of every frame.
        most_sinkhorn: Largest number of frames with a Sinkhorn divergence.
        correctors: What corrects each frame before the next is asked for, in order; None for what belongs to the model.
    """

    begun: Trajectory
    stored: Callable[[], Iterator[Tensor]]
    frames: int
    scene: Scene
    stride: int = STRIDE
    most_sinkhorn: int = MOST_SINKHORN
    correctors: Sequence[Corrector] | None = None

    @property
    def start(self) -> Window:
        """The window that the rollout begins with."""
        return window_at(self.begun, len(self.begun) - 1, len(self.begun), 0)


def asked_rollout(
    task: StepTask,
    stored: StoredFrames,
    scene: Scene,
    start: int = 0,
    frames: int | None = None,
    correctors: Sequence[Corrector] | None = None,
) -> Asked:
    """A rollout from a frame of a stored trajectory on.

    Args:
        task: Task of the model.
        stored: The trajectory.
        scene: Its scene.
        start: First frame of the window that the rollout begins with.
        frames: Number of frames to predict; None for all that are stored after the window.
        correctors: What corrects each frame; None for what belongs to the model.

    Raises:
        DataError: If the trajectory does not have all these frames.
    """
    first = start + task.history
    future = max(1, len(stored) - first) if frames is None else frames
    check_window(stored.name, len(stored), first - 1, task.history, future)
    return Asked(
        begun=stored.between(start, first),
        stored=lambda: (stored[place].positions for place in range(first, first + future)),
        frames=future,
        scene=scene,
        correctors=correctors,
    )


def record_rollout(
    model: Model,
    asked: Asked,
    keep: Keep = lambda positions, stored: None,
    progress: Callable[[Iterable, str], Iterable] = lambda items, _: items,
) -> RecordedRollout:
    """Roll a model out beside the stored frames; Ctrl-C and a divergence end it with the frames so far.

    All stored frames are read before it begins, so that a damaged one is found by then.

    Args:
        model: The model, of a step task.
        asked: The rollout.
        keep: Is handed each frame of the rollout and the stored one, (N, D), e.g. to write them.
        progress: Wraps the numbers of the frames to show progress, given a label.

    Raises:
        DataError: If the fluid has no mass, without which the rollout could not be measured, or a stored frame is
            damaged.
        Diverged: If the first frame would not be a state of particles any more.
        KeyboardInterrupt: If Ctrl-C came before a frame was measured.
    """
    path = rollout(model, asked.start.to(model.home), asked.scene, correctors=asked.correctors)
    meter = _meter(asked)
    times: list[float] = []
    ended = None
    try:
        for _, stored in zip(progress(range(asked.frames), "rollout"), asked.stored(), strict=True):
            before = time.perf_counter()
            present = next(path).present
            wait_for(model.device)
            spent = 1e3 * (time.perf_counter() - before)
            positions = present.cpu()
            keep(positions, stored)
            times.append(spent)
            meter.add(positions, stored)
    except (Diverged, KeyboardInterrupt) as error:
        if not len(meter):
            raise
        ended = f"diverged: {error.reason}" if isinstance(error, Diverged) else "interrupted"
    return RecordedRollout(
        start=asked.start,
        frames=len(times),
        milliseconds=np.array(times),
        metrics=meter.metrics(),
        ended=ended,
    )


def write_rollout(
    model: Model,
    asked: Asked,
    folder: Path,
    metadata: Mapping,
    keep: Keep = lambda positions, stored: None,
    progress: Callable[[Iterable, str], Iterable] = lambda items, _: items,
) -> RecordedRollout:
    """Record a rollout and write it frame by frame: it is the test split of a folder, what is stored the others.

    Args:
        model: The model, of a step task.
        asked: The rollout.
        folder: Folder to write, in the LagrangeBench layout; see `growing_dataset`.
        metadata: Further keys of metadata.json.
        keep: As for `record_rollout`, as is `progress`.

    Raises:
        CConvError: As `record_rollout` and `growing_dataset` do.
    """
    scene, dtype = replace(asked.scene, velocity_source=DIFFERENCES), asked.begun.positions.dtype
    with growing_dataset(folder, scene, asked.begun, metadata) as growing:

        def write(positions: Tensor, stored: Tensor) -> None:
            growing.append({"train": stored, "valid": stored, "test": positions.to(dtype)})
            keep(positions, stored)

        return record_rollout(model, asked, write, progress)


def _meter(asked: Asked) -> RolloutMeter:
    """Make what measures a rollout."""
    start, stride = asked.start, min(asked.stride, asked.frames)
    check_masses(start.masses, start.is_fluid)
    stored = itertools.chain([start.present], asked.stored())
    return RolloutMeter(
        start.present,
        start.masses,
        start.is_fluid,
        asked.scene,
        stride=stride,
        sinkhorn_stride=math.ceil(asked.frames // stride / asked.most_sinkhorn) if asked.most_sinkhorn else 0,
        speed_edges=speed_edges(stored, start.is_fluid, asked.scene, stride),
    )


def rollout_facts(recorded: RecordedRollout) -> dict:
    """Measures of a rollout, by the names of LagrangeBench's and Neural SPH's metrics."""
    metrics = recorded.metrics
    count = len(metrics.mse)
    return {
        "frames": recorded.frames,
        "ended": recorded.ended,
        "milliseconds_per_frame": recorded.milliseconds_per_frame,
        "mse_n": {str(n): float(metrics.mse[:n].mean()) for n in sorted({*LENGTHS, count}) if n <= count},
        "metrics": metrics.as_dict(),
    }
