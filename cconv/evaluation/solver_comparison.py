"""The solver and coarser ones beside the networks of a step task: the time of a frame, the error of their rollouts."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import chain

import numpy as np

from cconv.data.restart import restart
from cconv.data.splits import evenly_spaced
from cconv.evaluation.rollout_errors import RolloutErrors, rollout_errors_of
from cconv.evaluation.solver_cost import SolverCost, measure_state
from cconv.rollout.coarse_solver_model import CoarseSolverModel
from cconv.rollout.rollout import StepModel
from cconv.rollout.solver_model import SolverModel
from cconv.scenes.coarse import coarse_state, coarser_scenes, with_slow_sound
from cconv.scenes.simulated_scene import SimulatedScene
from cconv.tasks.samples import StepSample

MOST_ROLLOUTS = 4
MOST_WORK = 60_000_000  # particles times steps of all rollouts of the solver, about two minutes
REPEATS = 3  # timed frames of each solver


@dataclass(frozen=True, kw_only=True)
class MeasuredSolver:
    """A solver restarted from the frames that networks begin with.

    Attributes:
        factor: Its particle spacing ÷ that of the data; 1 for the solver that made them.
        sound_ratio: Its speed of sound ÷ the reference speed of the scene.
        cost: Cost of a frame, without the search for where the particles of the data are in a coarse flow.
        errors: Errors of its rollouts.
    """

    factor: float
    sound_ratio: float
    cost: SolverCost
    errors: tuple[RolloutErrors, ...]


def compared_rollouts(scene: SimulatedScene, samples: Sequence[StepSample]) -> list[StepSample]:
    """Choose evenly the rollouts that the solver is compared on; none if a single one would take too long.

    Args:
        scene: Scene of the samples, which says how many steps a frame takes.
        samples: Starts of rollouts.
    """
    first = samples[0].window
    work = scene.steps_per_frame * len(first.present) * len(first.future)
    return [samples[place] for place in evenly_spaced(len(samples), min(MOST_ROLLOUTS, MOST_WORK // work))]


def measure_solvers(
    scene: SimulatedScene, starts: Sequence[StepSample], *, until_ms: float, threads: int
) -> list[MeasuredSolver]:
    """Measure the solver, then coarser and coarser ones, until one takes no longer for a frame than is allowed.

    If it is not the solver itself, those with a lower speed of sound follow, again from the finest on.

    Args:
        scene: Scene of the starts.
        starts: Starts of rollouts, at least one.
        until_ms: Time of a frame at which no coarser one is measured, ms.
        threads: Number of torch threads of the timing.

    Raises:
        DataError: If the walls of the starts are not those of the scene.
        SimulationError: If the solver blows up while it is timed.
    """
    found: list[MeasuredSolver] = []
    for finest in filter(None, (scene, with_slow_sound(scene))):
        for run in chain([finest], coarser_scenes(finest)):
            found.append(_measured(scene, run, starts, threads))
            if found[-1].cost.ms_per_frame <= until_ms:
                break
        if len(found) == 1:
            break
    return found


def _measured(scene: SimulatedScene, run: SimulatedScene, starts: Sequence[StepSample], threads: int) -> MeasuredSolver:
    """Measure the solver of a scene, or of `run`, a cheaper form of it."""
    task, start = starts[0].task, starts[0].window
    factor = run.particle_spacing / scene.particle_spacing
    state = restart(run if factor == 1 else scene, start).state
    if factor != 1:
        state = coarse_state(scene, run, state)
    model = SolverModel(run, task) if factor == 1 else CoarseSolverModel(scene, run, task)
    return MeasuredSolver(
        factor=factor,
        sound_ratio=run.sound_ratio,
        cost=measure_state(run, state, threads=threads, repeats=REPEATS),
        errors=_errors(model, starts),
    )


def _errors(model: StepModel, starts: Sequence[StepSample]) -> tuple[RolloutErrors, ...]:
    """Errors of rollouts, one after another: a solver has a state, so that windows cannot be joined."""
    return tuple(rollout_errors_of(model, start) for start in starts)


def mean_error(models: Iterable[StepModel], starts: Sequence[StepSample]) -> float:
    """Error of the rollouts of some models from the starts, the mean over both."""
    return float(np.mean([each.error for model in models for each in _errors(model, starts)]))
