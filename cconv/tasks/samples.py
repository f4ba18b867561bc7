"""Samples: frames with what a network is given and what it has to answer."""

import math
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from cconv.batching import groups_of
from cconv.data.dataset import Dataset
from cconv.data.stored_frames import KEPT_BYTES, StoredFrames, kept_trajectories
from cconv.data.trajectory import Frame, Scene
from cconv.data.window import Origin, Window, Windows
from cconv.devices import moved
from cconv.errors import check_choice
from cconv.tasks.features import make_inputs
from cconv.tasks.inputs import Inputs, join_inputs
from cconv.tasks.task import FieldTask, StepTask, Task, as_field

MOST_SPREAD = 100
HORIZON = 20  # frames of the rollouts that models are compared by, unless another number is asked for


@dataclass(frozen=True, kw_only=True)
class Sample:
    """One frame to learn from, or several in one graph.

    Attributes:
        trajectory: Name of its trajectory, of the first frame if there are several.
        frame: Index of the frame in the stored trajectory, of the first if there are several.
        inputs: What the network is given.
        target: Answer (M, C) for the fluid particles, float32, in `target_unit`, as networks predict it.
        target_unit: What it is a multiple of, in the units of the data.
        joined: Where each of several frames comes from; empty for one.
    """

    trajectory: str
    frame: int
    inputs: Inputs
    target: Float[Tensor, "M C"]
    target_unit: float | Tensor
    joined: tuple[Origin, ...] = ()

    @property
    def origins(self) -> tuple[Origin, ...]:
        """Where the frame comes from, or each of several."""
        return self.joined or (Origin(self.trajectory, self.frame),)

    @property
    def nbytes(self) -> int:
        """Memory of what is given and asked, bytes."""
        inputs = self.inputs
        given = (inputs.positions, inputs.features.scalars, inputs.features.vectors, inputs.wall_positions, self.target)
        return sum(each.nbytes for each in given if each is not None)

    def to(self, device: torch.device) -> "Sample":
        """The same on a device."""
        return moved(self, device, ("inputs", "target", "target_unit"))


@dataclass(frozen=True, kw_only=True)
class StepSample(Sample):
    """One window, or several that are joined, to learn a step from, or to begin a rollout with.

    Attributes:
        window: Its frames, and those that follow as far as they are known.
        scene: Scene of the window.
        task: What is asked.
    """

    window: Window
    scene: Scene
    task: StepTask

    def to(self, device: torch.device) -> "StepSample":
        """The same on a device."""
        return moved(self, device, ("inputs", "target", "target_unit", "window"))


def make_sample(frame: Frame, scene: Scene, task: FieldTask, trajectory: str = "", index: int = 0) -> Sample:
    """Inputs with all features of a task, and its target, which is computed in float64, of one frame.

    Args:
        frame: Particles at one time.
        scene: Box of the particles.
        task: What is asked.
        trajectory: Name of the frame's trajectory.
        index: Index of the frame in it.
    """
    state = task.state(frame, scene)
    inputs = make_inputs(state, frame.boundary, scene, task.features)
    unit = task.unit(inputs.units)
    target = (task.field(state) / unit).float()
    return Sample(trajectory=trajectory, frame=index, inputs=inputs, target=target, target_unit=unit)


def make_step_sample(window: Window, scene: Scene, task: StepTask, names: Collection[str] | None = None) -> StepSample:
    """Inputs of a window, and the answer that leads to the first frame of its future, or what remains of it.

    Args:
        window: The window.
        scene: Its scene.
        task: What is asked.
        names: Features of the task that the inputs hold; None for all.
    """
    inputs = task.inputs(window, scene, task.features if names is None else names)
    unit, target = task.unit(inputs.units), task.target(window, scene)
    return StepSample(
        trajectory=window.trajectory,
        frame=window.frame,
        inputs=inputs,
        target=((target if inputs.known is None else target - inputs.known) / unit).float(),
        target_unit=unit,
        window=window,
        scene=scene,
        task=task,
        joined=window.joined,
    )


def join_samples(samples: Sequence[Sample]) -> list[Sample]:
    """Samples of frames in as few graphs as are sensible: alike, and with not too many particles together."""
    counts = [sample.inputs.num_particles for sample in samples]
    groups = groups_of(counts, [(sample.inputs.box, sample.inputs.wall_kinds) for sample in samples])
    return [_joined_sample([samples[number] for number in group]) for group in groups]


def _joined_sample(samples: Sequence[Sample]) -> Sample:
    """Sample of frames, at least one, in one graph."""
    if len(samples) == 1:
        return samples[0]
    first, inputs = samples[0], join_inputs([sample.inputs for sample in samples])
    units = [torch.full_like(sample.target[:, :1], float(sample.target_unit)) for sample in samples]
    return Sample(
        trajectory=first.trajectory,
        frame=first.frame,
        inputs=inputs,
        target=torch.cat([sample.target for sample in samples]),
        target_unit=torch.cat(units),
        joined=tuple(origin for sample in samples for origin in sample.origins),
    )


class FrameSamples(Sequence[Sample]):
    """Samples of all frames of a split of a field, in order; the first ones stay in memory until that is full.

    Others are made anew, and their frames read, whenever they are asked for. Nothing is evicted, as every sample
    returns once in each epoch.

    Args:
        dataset: Data set.
        split: "train", "valid" or "test".
        task: What is asked.
        most_bytes: Memory for samples.
        progress: Wraps the numbers of the frames to show progress while the first ones are made.
    """

    def __init__(
        self,
        dataset: Dataset,
        split: str,
        task: FieldTask,
        most_bytes: int = KEPT_BYTES,
        progress: Callable[[Iterable], Iterable] = iter,
    ):
        check_choice("split", split, dataset.splits)
        self._scene, self._task = dataset.scene, task
        self._frames = [StoredFrames(dataset, split, k) for k in range(len(dataset.splits[split]))]
        self._places = [(frames, index) for frames in self._frames for index in range(len(frames))]
        self._kept: list[Sample] = []
        for number in progress(range(len(self._places))):
            if most_bytes > 0:
                self._kept.append(self[number])
                most_bytes -= self._kept[-1].nbytes

    def __len__(self) -> int:
        return len(self._places)

    def __getitem__(self, index: Any) -> Any:
        if isinstance(index, slice):
            return [self[number] for number in range(*index.indices(len(self)))]
        number = range(len(self))[index]
        if number < len(self._kept):
            return self._kept[number]
        frames, place = self._places[number]
        return make_sample(frames[place], self._scene, self._task, frames.name, frames.first_frame + place)


class WindowSamples(Sequence[StepSample]):
    """Samples of windows, each made when it is asked for, because windows share their frames and samples do not.

    Args:
        windows: Windows with at least one frame of future, and at least as long as the history of the task.
        scene: Their scene.
        task: What is asked.
    """

    def __init__(self, windows: Sequence[Window], scene: Scene, task: StepTask):
        self.windows, self.scene, self.task = windows, scene, task

    def __len__(self) -> int:
        return len(self.windows)

    def __getitem__(self, index: Any) -> Any:
        if isinstance(index, slice):
            return WindowSamples(self.windows[index], self.scene, self.task)
        return make_step_sample(self.window(index), self.scene, self.task)

    def window(self, index: int) -> Window:
        """The window of a sample, no longer than the history of the task."""
        return self.windows[index].ending(self.task.history)

    def of_task(self, task: StepTask) -> "WindowSamples":
        """Samples of the same presents for another task, whose history is no longer."""
        return WindowSamples(self.windows, self.scene, task)

    @cached_property
    def spread(self) -> list[StepSample]:
        """Samples of at most `MOST_SPREAD` windows, evenly spread, whose statistics stand for those of all.

        They hold frames of their own: sent to another process, a part of a trajectory would take all of it along.
        """
        return [_alone(sample) for sample in self[:: math.ceil(len(self) / MOST_SPREAD)]]


def _alone(sample: StepSample) -> StepSample:
    """A sample whose window shares no frames with others, and goes on for no more than the frame to learn."""
    window = sample.window
    own = replace(window, positions=window.positions.clone(), future=window.future[:1].clone())
    return replace(sample, window=own)


def learned_samples(dataset: Dataset, split: str, task: StepTask, further: int = 0) -> WindowSamples:
    """Samples of all windows of a split that have a next frame, to learn from.

    Args:
        dataset: Data set.
        split: Usually "train".
        task: What is asked.
        further: Frames after the next one that each window has too, as far as they are stored.

    Raises:
        DataError: If a trajectory is too short for a single window.
    """
    check_choice("split", split, dataset.splits)
    return WindowSamples(
        Windows(kept_trajectories(dataset, split), task.history, 1, further=further), dataset.scene, task
    )


def rolled_samples(dataset: Dataset, split: str, task: StepTask, horizon: int) -> WindowSamples:
    """Samples of the windows that rollouts of a split begin with; these do not overlap, as in LagrangeBench.

    Args:
        dataset: Data set.
        split: "train", "valid" or "test".
        task: What is asked.
        horizon: Frames of each rollout, which are known after each window.

    Raises:
        DataError: If a trajectory is too short for a single one.
    """
    check_choice("split", split, dataset.splits)
    windows = Windows(kept_trajectories(dataset, split), task.history, horizon, stride=task.history + horizon)
    return WindowSamples(windows, dataset.scene, task)


def compared_samples(
    dataset: Dataset,
    split: str,
    task: Task,
    horizon: int = HORIZON,
    progress: Callable[[Iterable], Iterable] = iter,
) -> Sequence[Sample]:
    """Samples of a split that models are compared by: all frames of a field, or windows that rollouts begin with.

    Args:
        dataset: Data set.
        split: "train", "valid" or "test".
        task: What is asked.
        horizon: Frames of each rollout of a step task.
        progress: Wraps the numbers of the frames of a field to show progress while their samples are made.
    """
    if isinstance(task, StepTask):
        return rolled_samples(dataset, split, task, horizon)
    return FrameSamples(dataset, split, as_field(task), progress=progress)


def iterate_samples(dataset: Dataset, split: str, task: FieldTask) -> Iterator[Sample]:
    """Samples of all frames of a split, in order, one at a time; none stays in memory."""
    return iter(FrameSamples(dataset, split, task, most_bytes=0))
