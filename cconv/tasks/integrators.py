"""Integrators: how an answer becomes the next frame, and which answer would lead to the stored one."""

from typing import Protocol, runtime_checkable

from torch import Tensor

from cconv.data.trajectory import Scene
from cconv.data.window import Window


@runtime_checkable
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
    fluid have no acceleration: walls stay, and a lid that slides at a constant speed goes on. Source: Sanchez-Gonzalez
    et al., "Learning to Simulate Complex Physics with Graph Networks" (ICML 2020), section 3.2; LagrangeBench (Toshev
    et al., 2023).
    """

    def advance(self, window: Window, prediction: Tensor, scene: Scene) -> Window:
        """The window a frame later; arguments as of `Integrator.advance`."""
        velocities = window.last_displacements(scene.box)
        velocities[window.is_fluid] += prediction.double()
        following = scene.box.wrap(window.present.double() + velocities)
        return window.followed_by(following.to(window.positions.dtype))

    def target(self, window: Window, scene: Scene) -> Tensor:
        """Second difference (M, D) of the positions of the fluid at the present frame, float64."""
        displacements = scene.box.displacement(window.future[0].double(), window.present.double())
        return (displacements - window.last_displacements(scene.box))[window.is_fluid]
