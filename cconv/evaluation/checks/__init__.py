"""Checks of stability, one file each: they find where a model fails that is accurate on average.

A model may fail at the free surface, where particles clump (tensile instability), or where a scene is denser or faster
than the training data. A task names the checks that its models must pass.
"""

from typing import Any

from cconv.evaluation.checks.check import Check
from cconv.evaluation.checks.completion import Completion
from cconv.evaluation.checks.density import IntegratedDensity
from cconv.evaluation.checks.material import Material
from cconv.evaluation.checks.motion import Motion
from cconv.evaluation.checks.packing import Packing
from cconv.evaluation.checks.precision import Precision
from cconv.evaluation.checks.regimes import Regimes
from cconv.evaluation.checks.rolled import RolloutMaterial
from cconv.evaluation.checks.still import StillStates
from cconv.evaluation.checks.stress import StressedStates

_OF_FIELDS = (Regimes, StressedStates, StillStates, Precision, IntegratedDensity)
_OF_STEPS = (Completion, Motion, Packing)
CHECKS: dict[str, type[Check[Any, Any]]] = {check.name: check for check in (*_OF_FIELDS, *_OF_STEPS)}


def make_checks(material: Material | RolloutMaterial) -> list[Check[Any, Any]]:
    """Make every check that the task names, once for all models."""
    return [CHECKS[name](material) for name in material.task.checks]
