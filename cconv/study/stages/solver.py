"""The solver beside the recommended model of a step: part of the select stage."""

import numpy as np

from cconv.errors import CConvError
from cconv.evaluation.solver_comparison import MeasuredSolver, compared_rollouts, mean_error, measure_solvers
from cconv.scenes.find import find_scene
from cconv.study.records.summary import SolverComparison, SolverPoint
from cconv.study.stages.finalists import Retrained
from cconv.study.stages.session import Session
from cconv.tasks.samples import WindowSamples


def compare_with_solver(
    session: Session, chosen: Retrained, ms_per_frame: float, samples: WindowSamples
) -> SolverComparison:
    """Measure the solver that made the data, and coarser ones until they are as fast as the recommended model.

    Args:
        session: The study.
        chosen: The recommended finalist.
        ms_per_frame: Its time.
        samples: Starts of the rollouts of the test split.

    Returns:
        The comparison, or the reason why the solver was not measured.
    """
    simulated, reason = find_scene({"dim": session.dataset.scene.dim, **session.dataset.metadata})
    if simulated is None:
        return SolverComparison(why_none=reason)
    starts = compared_rollouts(simulated, samples)
    if not starts:
        return SolverComparison(why_none="a single rollout of the solver would take minutes")
    if simulated.varying_viscosity:
        return SolverComparison(why_none="trajectories of the scene differ in viscosity")
    try:
        found = measure_solvers(simulated, starts, until_ms=ms_per_frame, threads=session.study.cost.threads)
    except CConvError as error:
        return SolverComparison(why_none=str(error).removesuffix("."))
    return SolverComparison(
        points=tuple(map(_point, found)),
        rollouts=len(starts),
        network_error=mean_error(map(session.load_model, chosen.checkpoints), starts),
    )


def _point(found: MeasuredSolver) -> SolverPoint:
    cost = found.cost
    return SolverPoint(
        factor=found.factor,
        sound_ratio=found.sound_ratio,
        num_particles=cost.num_particles,
        steps=cost.steps,
        ms_per_frame=cost.ms_per_frame,
        ms_low=cost.ms_low,
        ms_high=cost.ms_high,
        error=float(np.mean([each.error for each in found.errors])),
        diverged=float(np.mean([each.diverged is not None for each in found.errors])),
    )
