"""Tasks: what is asked of a network."""

from cconv.errors import check_choice
from cconv.tasks.density_gradient import DensityGradient
from cconv.tasks.density_rate import DensityRate
from cconv.tasks.task import FieldTask

TASKS: dict[str, type[FieldTask]] = {task.name: task for task in (DensityRate, DensityGradient)}


def task_named(name: str, kernel: str = "cubic_spline", relative_smoothing_length: float = 1.0) -> FieldTask:
    """The task of a name, with its SPH kernel.

    Raises:
        ConfigError: If there is none of that name.
    """
    check_choice("task", name, TASKS)
    return TASKS[name](kernel, relative_smoothing_length)
