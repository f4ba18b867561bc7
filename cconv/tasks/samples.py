"""Samples: frames with what a network is given and what it has to answer."""

from collections.abc import Iterator
from dataclasses import dataclass

from jaxtyping import Float
from torch import Tensor

from cconv.data.dataset import Dataset
from cconv.data.trajectory import Frame, Scene
from cconv.errors import check_choice
from cconv.tasks.features import Inputs, make_inputs
from cconv.tasks.task import FieldTask


@dataclass(frozen=True, kw_only=True)
class Sample:
    """One frame to learn from.

    Attributes:
        trajectory: Name of its trajectory.
        frame: Index of the frame in the stored trajectory.
        inputs: What the network is given.
        target: Analytic field (N, C) at the fluid particles, float32, in `target_unit`, as networks predict it.
        target_unit: What it is a multiple of, in the units of the data.
    """

    trajectory: str
    frame: int
    inputs: Inputs
    target: Float[Tensor, "N C"]
    target_unit: float


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


def iterate_samples(dataset: Dataset, split: str, task: FieldTask) -> Iterator[Sample]:
    """Samples of all frames of a split, in order."""
    check_choice("split", split, dataset.splits)
    for trajectory in dataset.trajectories(split):
        for index, frame in enumerate(trajectory):
            yield make_sample(frame, dataset.scene, task, trajectory.name, trajectory.first_frame + index)
