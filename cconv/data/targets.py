"""What a network learns: the analytic SPH fields of a frame."""

from collections.abc import Iterator
from dataclasses import dataclass

from torch import Tensor

from cconv.data.dataset import Dataset
from cconv.data.features import FluidState, Inputs, Units, fluid_state, make_inputs
from cconv.data.trajectory import Frame, Scene
from cconv.errors import check_choice
from cconv.sph.operators import density_gradient, density_rate


def _density_rate(state: FluidState, kernel) -> Tensor:
    return density_rate(state.masses, state.velocities, state.edges, kernel)[:, None]


def _density_gradient(state: FluidState, kernel) -> Tensor:
    return density_gradient(state.masses, state.densities, state.edges, kernel)


TASKS = {"density_rate": _density_rate, "density_gradient": _density_gradient}
VECTOR_TASKS = ("density_gradient",)  # targets that turn with the scene


def target_channels(task: str, dim: int) -> int:
    """Components of a task's target: 1 for "density_rate" (D2), D for "density_gradient" (D3)."""
    check_choice("task", task, TASKS)
    return dim if task in VECTOR_TASKS else 1


def target_unit(task: str, units: Units) -> float:
    """Unit of a task's target: rest density a time for D2, rest density a spacing for D3."""
    return units.density / (units.length if task in VECTOR_TASKS else units.time)


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
    target: Tensor
    target_unit: float


def make_sample(frame: Frame, scene: Scene, task: str, kernel, trajectory: str = "", index: int = 0) -> Sample:
    """Inputs and target of one frame.

    The target is computed in float64 over fluid particles only (thesis eq. D2, D3).

    Args:
        frame: Particles at one time.
        scene: Box of the particles.
        task: "density_rate" or "density_gradient".
        kernel: SPH kernel of densities and targets.
        trajectory: Name of the frame's trajectory.
        index: Index of the frame in it.

    Raises:
        ConfigError: If the task is unknown.
    """
    check_choice("task", task, TASKS)
    state = fluid_state(frame, scene.box, kernel)
    inputs = make_inputs(state, frame.boundary, scene)
    unit = target_unit(task, inputs.units)
    return Sample(
        trajectory=trajectory,
        frame=index,
        inputs=inputs,
        target=(TASKS[task](state, kernel) / unit).float(),
        target_unit=unit,
    )


def iterate_samples(dataset: Dataset, split: str, task: str, kernel) -> Iterator[Sample]:
    """Samples of all frames of a split, in order."""
    check_choice("split", split, dataset.splits)
    for trajectory in dataset.trajectories(split):
        for index, frame in enumerate(trajectory):
            yield make_sample(frame, dataset.scene, task, kernel, trajectory.name, trajectory.first_frame + index)
