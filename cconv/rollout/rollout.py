"""The rollout: every answer of a model leads to the frame that the next one is asked about."""

from collections.abc import Callable, Iterator

from torch import Tensor

from cconv.data.trajectory import Scene
from cconv.data.window import Window
from cconv.rollout.integrators import Integrator


def rollout(
    predict: Callable[[Window, Scene], Tensor], integrator: Integrator, start: Window, scene: Scene
) -> Iterator[Window]:
    """Windows after a start, a frame later each, for as long as they are asked for.

    Args:
        predict: Window and scene to the answer (M, D) for each of the M fluid particles.
        integrator: What turns an answer into the next frame.
        start: The window to begin with; its future is not looked at, unless `predict` does.
        scene: Its scene.
    """
    window = start
    while True:
        window = integrator.advance(window, predict(window, scene), scene)
        yield window
