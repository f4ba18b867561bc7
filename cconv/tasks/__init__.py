"""Tasks: what is asked of a network."""

from dataclasses import replace

from cconv.errors import check_choice
from cconv.tasks.acceleration import Acceleration
from cconv.tasks.density_gradient import DensityGradient
from cconv.tasks.density_rate import DensityRate
from cconv.tasks.position_correction import PositionCorrection
from cconv.tasks.task import FieldTask, Task, as_step

TASKS: dict[str, type[Task]] = {
    task.name: task for task in (DensityRate, DensityGradient, Acceleration, PositionCorrection)
}


def field_tasks() -> list[FieldTask]:
    """Make the tasks that ask for a field, with their usual kernels."""
    return [task() for task in TASKS.values() if issubclass(task, FieldTask)]


def task_named(
    name: str,
    kernel: str = "cubic_spline",
    relative_smoothing_length: float = 1.0,
    history: int | None = None,
    force_travel: float | None = None,
) -> Task:
    """The task of a name, with its SPH kernel.

    Args:
        name: One of `TASKS`.
        kernel: Field name of the kernel.
        relative_smoothing_length: Its h in particle spacings.
        history: Frames that an answer depends on; None for as many as usual.
        force_travel: For a step to which the integrator adds the external force, see `StepTask`.

    Raises:
        ConfigError: If there is none of that name, it cannot have that history, or a field would have a force.
    """
    check_choice("task", name, TASKS)
    task = TASKS[name]
    frames = task.history if history is None else history
    task.check_history(frames)
    asked = task(kernel, relative_smoothing_length, frames)
    return asked if force_travel is None else replace(as_step(asked), force_travel=force_travel)
