"""Checks of stability, one file each: they find where a model fails that is accurate on average.

A model may fail at the free surface, where particles clump (tensile instability), or where a scene is denser or faster
than the training data. A task names the checks that its models must pass.
"""

from collections.abc import Sequence
from typing import Any

from cconv.data.trajectory import Frames, Scene
from cconv.evaluation.checks.check import Check
from cconv.evaluation.checks.completion import Completion
from cconv.evaluation.checks.density import IntegratedDensity
from cconv.evaluation.checks.later_start import LaterStart
from cconv.evaluation.checks.mapped_starts import MappedStarts
from cconv.evaluation.checks.material import Material, make_material
from cconv.evaluation.checks.motion import Motion
from cconv.evaluation.checks.packing import Packing
from cconv.evaluation.checks.perturbed_starts import PerturbedStarts
from cconv.evaluation.checks.precision import Precision
from cconv.evaluation.checks.regimes import Regimes
from cconv.evaluation.checks.rolled import RolloutMaterial, make_rollout_material
from cconv.evaluation.checks.still import StillStates
from cconv.evaluation.checks.stress import StressedStates
from cconv.tasks.task import StepTask, Task, as_field

_OF_FIELDS = (Regimes, StressedStates, StillStates, Precision, IntegratedDensity)
_OF_STEPS = (Completion, Motion, Packing, PerturbedStarts, MappedStarts, LaterStart)
CHECKS: dict[str, type[Check[Any, Any]]] = {check.name: check for check in (*_OF_FIELDS, *_OF_STEPS)}


def material_for(task: Task, trajectories: Sequence[Frames], scene: Scene, reach: float) -> Material | RolloutMaterial:
    """Prepare what the models of a task are checked on: frames of a field, or the starts of rollouts.

    Args:
        task: Task of the models.
        trajectories: Trajectories that no model was trained on.
        scene: Their scene.
        reach: Largest distance that a model searches.
    """
    if isinstance(task, StepTask):
        return make_rollout_material(trajectories, scene, task)
    return make_material(trajectories, scene, as_field(task), reach)


def make_checks(material: Material | RolloutMaterial) -> list[Check[Any, Any]]:
    """Make every check that the task names, once for all models."""
    return [CHECKS[name](material) for name in material.task.checks]
