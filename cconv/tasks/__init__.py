"""Tasks: what is asked of a network."""

from cconv.errors import check_choice
from cconv.tasks.acceleration import Acceleration
from cconv.tasks.density_gradient import DensityGradient
from cconv.tasks.density_rate import DensityRate
from cconv.tasks.task import Task

TASKS: dict[str, type[Task]] = {task.name: task for task in (DensityRate, DensityGradient, Acceleration)}


def task_named(
    name: str, kernel: str = "cubic_spline", relative_smoothing_length: float = 1.0, history: int | None = None
) -> Task:
    """The task of a name, with its SPH kernel.

    Args:
        name: One of `TASKS`.
        kernel: Field name of the kernel.
        relative_smoothing_length: Its h in particle spacings.
        history: Frames that an answer depends on; None for as many as usual.

    Raises:
        ConfigError: If there is none of that name, or it cannot have that history.
    """
    check_choice("task", name, TASKS)
    task = TASKS[name]
    frames = task.history if history is None else history
    task.check_history(frames)
    return task(kernel, relative_smoothing_length, frames)
