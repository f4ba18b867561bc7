"""Integrators: how an answer becomes the next frame, and which answer would lead to the stored one."""

from typing import Protocol

from torch import Tensor

from cconv.data.trajectory import Scene
from cconv.data.window import Window
from cconv.errors import ShapeError
from cconv.rollout.prescribed import carried_on


class Integrator(Protocol):
    """Leads from a window to the next frame.

    One law holds for all: ``advance(window, target(window, scene), scene)`` has the stored next frame as its present,
    so that a rollout of targets has no error. What is no fluid must rest or move at a constant velocity for it.
    """

    def advance(self, window: Window, prediction: Tensor, scene: Scene) -> Window:
        """The window a frame later.

        Args:
            window: At least two frames.
            prediction: Answer (M, D) for each of the M fluid particles.
            scene: Scene of the window.
        """

    def target(self, window: Window, scene: Scene) -> Tensor:
        """The answer (M, D) that leads to the first frame of the window's future, float64."""


class SemiImplicitEuler:
    r"""Moves particles by an acceleration, in the units of frames: length per frame, length per frame squared.

    .. math:: v^{k+1} = v^k + a^k, \qquad x^{k+1} = x^k + v^{k+1}, \qquad v^k = x^k - x^{k-1}

    Differences are minimum-image displacements, and positions are wrapped at periodic faces. Particles that are not
    fluid move as prescribed. Source: Sanchez-Gonzalez et al., "Learning to Simulate Complex Physics with Graph
    Networks" (ICML 2020), section 3.2; LagrangeBench (Toshev et al., 2023).
    """

    def advance(self, window: Window, prediction: Tensor, scene: Scene) -> Window:
        """The window a frame later; arguments as of `Integrator.advance`."""
        now, fluid = _last_two(window), window.is_fluid
        velocities = scene.box.displacement(now[1, fluid], now[0, fluid]) + prediction.double()
        following = carried_on(window, scene)
        following[fluid] = scene.box.wrap(now[1, fluid] + velocities)
        return window.followed_by(following.to(window.positions.dtype))

    def target(self, window: Window, scene: Scene) -> Tensor:
        """Second difference (M, D) of the positions of the fluid at the present frame, float64."""
        fluid, following = window.is_fluid, window.future[0].double()
        before, now = _last_two(window)[:, fluid]
        return scene.box.displacement(following[fluid], now) - scene.box.displacement(now, before)


def _last_two(window: Window) -> Tensor:
    """The last two frames (2, N, D), float64.

    Raises:
        ShapeError: If there are fewer, which say nothing of velocities.
    """
    if len(window.positions) < 2:
        raise ShapeError(f"a window must have at least 2 frames up to the present, got {len(window.positions)}.")
    return window.positions[-2:].double()
