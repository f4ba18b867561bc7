"""A coarser solver in the place of a model of a step task: it carries the particles of the data along."""

from dataclasses import replace

from torch import Tensor

from cconv.data.restart import restart
from cconv.data.simulate import next_frame
from cconv.data.trajectory import Scene
from cconv.data.window import Window
from cconv.errors import SimulationError
from cconv.rollout.rollout import Diverged
from cconv.rollout.solver_model import check_alone, has_reached
from cconv.scenes.coarse import coarse_state, velocities_at
from cconv.scenes.simulated_scene import SimulatedScene
from cconv.sph.solver import ParticleState
from cconv.tasks.task import StepTask

CARRIED = 5  # times in a frame that the particles are moved by the coarse flow, if it has as many steps


class CoarseSolverModel:
    """Answers with where a coarser flow carries the particles of a window.

    The coarse flow begins from the particles of a window, as models do, and goes on from its own state when it is
    asked about the frame that it has led to.

    Args:
        simulated: Scene of the windows, e.g. of `find_scene`.
        coarse: The same scene, coarser, of `cconv.scenes.coarse`.
        task: What is asked.
    """

    def __init__(self, simulated: SimulatedScene, coarse: SimulatedScene, task: StepTask):
        self.task, self._simulated, self._coarse = task, simulated, coarse
        self._state: ParticleState | None = None
        self._reached: Window | None = None

    def predict_frame(self, frame: Window, scene: Scene) -> Tensor:
        """Answer (M, D) for each of the M fluid particles at the end of a window.

        Raises:
            Diverged: If a simulation blows up.
            ShapeError: If several windows are joined.
        """
        check_alone(frame)
        fluid = frame.is_fluid
        try:
            if self._state is None or not has_reached(self._reached, frame, scene):
                begun = restart(self._simulated, frame).state
                self._state = coarse_state(self._simulated, self._coarse, begun)
            present = frame.present.double().clone()
            present[fluid], self._state = self._carried(present[fluid], self._state)
        except SimulationError as error:
            self._state = self._reached = None
            raise Diverged(frame.frame + 1, str(error).removesuffix(".")) from error
        self._reached = frame.followed_by(scene.box.wrap(present))
        return self.task.target(replace(frame, future=self._reached.present[None]), scene)

    def _carried(self, points: Tensor, state: ParticleState) -> tuple[Tensor, ParticleState]:
        """Move points (M, D) with the flow to the next frame, by the mean of the velocities before and after."""
        coarse, solver = self._coarse, self._coarse.solver()
        times = min(CARRIED, coarse.steps_per_frame)
        stops = [round(place * coarse.steps_per_frame / times) for place in range(times + 1)]
        before = velocities_at(points, self._simulated, coarse, state)
        for begin, end in zip(stops[:-1], stops[1:], strict=True):
            state = next_frame(replace(coarse, steps_per_frame=end - begin), solver, state)
            time = (end - begin) * coarse.time_step
            after = velocities_at(points + time * before, self._simulated, coarse, state)
            points = points + time * (before + after) / 2
            before = after
        return points, state
