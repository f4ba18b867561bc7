"""Plausibility of what networks have to learn: targets that hardly differ between particles teach nothing."""

from collections.abc import Sequence

import torch

from cconv.data.dataset import Dataset
from cconv.data.plausibility import DataFinding
from cconv.data.splits import evenly_spaced
from cconv.data.stored_frames import StoredFrames
from cconv.data.trajectory import Frames, Scene
from cconv.errors import ConfigError
from cconv.tasks.samples import Sample, make_sample
from cconv.tasks.task import FieldTask, Task

FRAMES = 5  # of the training split in which fields are computed, evenly spaced over its trajectories
SMALLEST_SPREAD = 1e-9  # of targets, in multiples of their unit; rounding in float64 is far below


def target_findings(samples: Sequence[Sample], task: Task, stops: bool) -> list[DataFinding]:
    """A finding if the targets of samples hardly differ, or an empty list.

    Args:
        samples: Samples of the task; at least one.
        task: What is asked.
        stops: Whether such data are of no use, as nothing else is asked of them.
    """
    targets = torch.cat([sample.target.double() for sample in samples])
    spread = float(targets.std(dim=0, correction=0).max())
    if spread > SMALLEST_SPREAD:
        return []
    text = (
        f"the target of the task {task.name!r}, {task.symbol}, is the same for all particles (its spread is "
        f"{spread:.3g} of its unit), so there is nothing to learn; take frames in which the fluid moves"
    )
    first = samples[0]
    return [
        DataFinding(
            check=_name(task),
            trajectory=first.trajectory,
            frame=first.frame,
            particle=None,
            text=text,
            stops=stops,
        )
    ]


def field_findings(dataset: Dataset, tasks: Sequence[FieldTask]) -> list[DataFinding]:
    """Fields that hardly differ in a few frames of the training split, a finding each.

    Args:
        dataset: The data set.
        tasks: Tasks whose fields are computed.

    Raises:
        DataError: If the data are damaged.
    """
    chosen = [StoredFrames(dataset, "train", k) for k in evenly_spaced(len(dataset.splits["train"]), FRAMES)]
    return [finding for task in tasks for finding in _of_field(dataset, task, chosen)]


def _of_field(dataset: Dataset, task: FieldTask, chosen: Sequence[Frames]) -> list[DataFinding]:
    """Findings about a field in the last frames of some trajectories, one of them if it cannot be computed there."""
    try:
        samples = [_last_sample(each, dataset.scene, task) for each in chosen]
    except ConfigError as error:
        text = f"the task {task.name!r} cannot be asked of these data: {error}"
        first = chosen[0]
        return [
            DataFinding(check=_name(task), trajectory=first.name, frame=first.first_frame, particle=None, text=text)
        ]
    return target_findings(samples, task, stops=False)


def _last_sample(frames: Frames, scene: Scene, task: FieldTask) -> Sample:
    last = len(frames) - 1
    return make_sample(frames[last], scene, task, frames.name, frames.first_frame + last)


def _name(task: Task) -> str:
    return f"target_{task.name}"
