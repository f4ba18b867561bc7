"""An integrator that adds an external force, so that networks learn the rest of the acceleration."""

from dataclasses import dataclass

from torch import Tensor

from cconv.data.smoothed_force import evaluated
from cconv.data.trajectory import Scene
from cconv.data.window import Window
from cconv.errors import ConfigError
from cconv.forces import Accelerating, Force
from cconv.tasks.integrators import Integrator


@dataclass(frozen=True)
class WithExternalForce:
    r"""Adds the acceleration by a force, in units of frames, to an answer, and takes it off a target.

    .. math:: a = \text{answer} + T^2 g(x)

    with T the time between frames and x the present position. Where the force varies over the distance that particles
    travel in a frame, give a smoothed one, e.g. of `cconv.data.smoothed_force.smoothed`. Networks must be standardised
    by the targets of this integrator. Source: Toshev et al., "Neural SPH" (ICML 2024), eq. 4.

    Attributes:
        integrator: Moves particles by the whole acceleration.
        force: Positions (M, D) of the fluid to accelerations (M, D), length/time².
    """

    integrator: Integrator
    force: Accelerating

    def before(self, window: Window, scene: Scene) -> Window:
        """The window as the integrator that is added to asks about it."""
        return self.integrator.before(window, scene)

    def advance(self, window: Window, prediction: Tensor, scene: Scene) -> Window:
        """The window a frame later; arguments as of `Integrator.advance`.

        Raises:
            ShapeError: If the force does not return one vector for each position.
            ConfigError: If it returns NaN or infinity.
        """
        return self.integrator.advance(window, prediction.double() + self._acceleration(window, scene), scene)

    def target(self, window: Window, scene: Scene) -> Tensor:
        """The answer (M, D) that leads to the first frame of the window's future, float64."""
        return self.integrator.target(window, scene) - self._acceleration(window, scene)

    def _acceleration(self, window: Window, scene: Scene) -> Tensor:
        """Acceleration by the force at the present (M, D), length per frame squared."""
        return scene.frame_dt**2 * evaluated(self.force, window.present[window.is_fluid].double())


@dataclass(frozen=True)
class WithForceOfScene:
    """Adds the external force of the scene, smoothed over the distance that particles travel in a frame.

    Attributes:
        integrator: Moves particles by the whole acceleration.
        travel: Standard deviation of the displacements of a frame along an axis, in particle spacings.
    """

    integrator: Integrator
    travel: float

    def before(self, window: Window, scene: Scene) -> Window:
        """The window as the integrator that is added to asks about it."""
        return self.integrator.before(window, scene)

    def advance(self, window: Window, prediction: Tensor, scene: Scene) -> Window:
        """The window a frame later; arguments as of `Integrator.advance`.

        Raises:
            ConfigError: If the scene has no force.
        """
        return self._of_scene(scene).advance(window, prediction, scene)

    def target(self, window: Window, scene: Scene) -> Tensor:
        """The answer (M, D) that leads to the first frame of the window's future, float64."""
        return self._of_scene(scene).target(window, scene)

    def _of_scene(self, scene: Scene) -> WithExternalForce:
        force = force_to_add(scene).smoothed(self.travel * scene.particle_spacing)
        return WithExternalForce(self.integrator, force)


def force_to_add(scene: Scene) -> Force:
    """External force of a scene, for an integrator to add.

    Raises:
        ConfigError: If the scene has none, or it is not known.
    """
    if scene.force is None:
        raise ConfigError(
            f"scene {scene.name!r}: there is no external force, and an integrator is to add it; give the force of the "
            "data, or leave it to the network."
        )
    return scene.force
