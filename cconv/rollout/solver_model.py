"""The solver in the place of a model of a step task, so that rollouts, their errors and their checks apply to it."""

from collections.abc import Iterator
from dataclasses import replace

from torch import Tensor

from cconv.data.restart import solved_frames
from cconv.data.trajectory import Scene
from cconv.data.window import Window
from cconv.errors import ShapeError, SimulationError
from cconv.rollout.rollout import Diverged
from cconv.scenes.simulated_scene import SimulatedScene
from cconv.tasks.task import StepTask

_SAME = 1e-6  # particle spacings between the solver's frame and the same one after the integrator's rounding


class SolverModel:
    """Answers with what leads to the solver's next frame.

    It begins from the positions of a window, as models do, and goes on from its own state when it is asked about the
    frame that it has led to.

    Args:
        simulated: Scene of the windows, e.g. of `find_scene`.
        task: What is asked.
    """

    def __init__(self, simulated: SimulatedScene, task: StepTask):
        self.task, self._simulated = task, simulated
        self._frames: Iterator[Window] = iter(())
        self._reached: Window | None = None

    def predict_frame(self, frame: Window, scene: Scene) -> Tensor:
        """Answer (M, D) for each of the M fluid particles at the end of a window.

        Raises:
            Diverged: If the simulation blows up.
            ShapeError: If several windows are joined.
        """
        check_alone(frame)
        if not has_reached(self._reached, frame, scene):
            self._frames = solved_frames(self._simulated, frame)
        try:
            self._reached = next(self._frames)
        except SimulationError as error:
            self._reached = None
            raise Diverged(frame.frame + 1, str(error).removesuffix(".")) from error
        return self.task.target(replace(frame, future=self._reached.present[None]), scene)


def check_alone(window: Window) -> None:
    """Check that a solver is asked about one window.

    Raises:
        ShapeError: If several are joined.
    """
    if window.joined:
        raise ShapeError(f"a solver carries one window on after another, got {len(window.joined)} that are joined.")


def has_reached(last: Window | None, frame: Window, scene: Scene) -> bool:
    """Tell whether a window's present is the one that a simulation has led to, None if there is none."""
    if last is None or last.present.shape != frame.present.shape:
        return False
    fluid = frame.is_fluid
    apart = scene.box.displacement(last.present[fluid], frame.present[fluid].double())
    return bool((apart.abs() < _SAME * scene.particle_spacing).all())
