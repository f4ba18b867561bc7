"""The checks of stability of a study, whose limits and starts come from its validation trajectories."""

from typing import Any

from cconv.data.stored_frames import kept_trajectories
from cconv.evaluation.checks import make_checks, material_for
from cconv.evaluation.checks.check import Check
from cconv.study.stages.session import Session


def stability_checks(session: Session, reach: float) -> tuple[Any, list[Check[Any, Any]]]:
    """Prepare what models are checked on, and the checks of the task; the test split is not read.

    Args:
        session: The study.
        reach: Largest distance that a model searches.
    """
    trajectories = kept_trajectories(session.dataset, "valid")
    material = material_for(session.problem.task, trajectories, session.dataset.scene, reach)
    return material, make_checks(material)
