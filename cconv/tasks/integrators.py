"""Integrators: how an answer becomes the next frame, and which answer would lead to the stored one."""

from dataclasses import replace
from typing import Protocol, runtime_checkable

import torch
from torch import Tensor

from cconv.data.smoothed_force import evaluated
from cconv.data.trajectory import Scene
from cconv.data.window import Window


@runtime_checkable
class Integrator(Protocol):
    """Leads from a window to the next frame.

    One law holds for all: ``advance(window, target(window, scene), scene)`` has the stored next frame as its present,
    so that a rollout of targets has no error. What is no fluid must rest or move at a constant velocity for it.
    """

    def before(self, window: Window, scene: Scene) -> Window:
        """The window as the network is asked about it, as long as this one; the window itself where nothing is known.

        It may already be moved by what needs no network, such as gravity.
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

    def before(self, window: Window, scene: Scene) -> Window:
        """The window itself."""
        return window

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


class CorrectedFall:
    r"""Moves particles by the external force of the scene, and then by a correction, in the units of frames.

    .. math::
        v^* = v^k + g(x^k), \qquad x^* = x^k + (v^k + v^*) / 2, \qquad x^{k+1} = x^* + \Delta x^k,
        \qquad v^k = x^k - x^{k-1}

    with g in length per frame squared. Networks are asked about x* and v*. Particles that are not fluid go on as they
    did. Source: Ummenhofer et al., "Lagrangian Fluid Simulation with Continuous Convolutions" (ICLR 2020), section 4,
    equations 4 to 7; `models/default_torch.py` of its code.
    """

    def before(self, window: Window, scene: Scene) -> Window:
        """The window whose present is x*, and whose last displacement is v*; float64."""
        present, velocities = self._fallen(window, scene)
        past = torch.cat([window.positions[1:-1].double(), torch.stack([present - velocities, present])])
        return replace(window, positions=past)

    def advance(self, window: Window, prediction: Tensor, scene: Scene) -> Window:
        """The window a frame later; arguments as of `Integrator.advance`."""
        present, _ = self._fallen(window, scene)
        corrections = torch.zeros_like(present)
        corrections[window.is_fluid] += prediction.double()
        return window.followed_by(scene.box.wrap(present + corrections).to(window.positions.dtype))

    def target(self, window: Window, scene: Scene) -> Tensor:
        """Correction (M, D) that leads the fluid to the first frame of the window's future, float64."""
        present, _ = self._fallen(window, scene)
        return scene.box.displacement(window.future[0].double(), present)[window.is_fluid]

    def _fallen(self, window: Window, scene: Scene) -> tuple[Tensor, Tensor]:
        """Positions x* and velocities v* (N, D), float64; positions are not wrapped."""
        velocities, present = window.last_displacements(scene.box), window.present.double()
        if scene.force is None:
            return present + velocities, velocities
        falling = scene.frame_dt**2 * evaluated(scene.force, present) * window.is_fluid[:, None]
        return present + velocities + falling / 2, velocities + falling
