"""Correctors: what changes a frame after every step of a rollout, before the model is asked about it."""

from dataclasses import dataclass, replace
from typing import Any, Protocol

import torch

from cconv.data.trajectory import Scene
from cconv.data.window import Window
from cconv.models.model import Model
from cconv.sph.relaxation import check_relaxation, relax


class Corrector(Protocol):
    """Corrects the frame that a step has led to.

    The corrected positions enter the window, so the next velocity follows from them.
    """

    def __call__(self, before: Window, after: Window, scene: Scene) -> Window:
        """The window after a step with its present corrected; nothing else in it changes.

        Args:
            before: The window before the step.
            after: The window after it, a frame later.
            scene: Their scene.

        Raises:
            SimulationError: If the frame cannot be corrected, which ends the rollout.
        """


def correctors_of(model: Any) -> tuple[Corrector, ...]:
    """Correctors that belong to a model: the relaxation of a saved one, if it has one; none for anything else."""
    settings = model.config.relaxation if isinstance(model, Model) else None
    return () if settings is None else (SPHRelaxation(settings.alpha, settings.beta, settings.loops),)


@dataclass(frozen=True)
class SPHRelaxation:
    """Spreads particles evenly by a few shifts with pressure and viscosity; see `cconv.sph.relaxation`.

    Learned steps let particles cluster slowly, which the density shows and the error of a step does not. Whatever is
    not fluid counts as a wall and keeps its place; walls that are points, without particles, are not seen. Values to
    start from are alpha 0.02 and 1 to 5 loops; too large ones shake the velocities that the model knows. Derivatives
    pass as if the shifts did not depend on the positions.

    Source: Toshev et al., "Neural SPH" (ICML 2024), eqs. 5 and 6; effects and values used are in its tables 1 to 3.

    Attributes:
        alpha: Size of the shift.
        beta: Viscosity relative to the pressure.
        loops: Shifts in a frame.

    Raises:
        ConfigError: If a setting cannot be.
    """

    alpha: float
    beta: float = 0.0
    loops: int = 1

    def __post_init__(self) -> None:
        check_relaxation(self.alpha, self.beta, self.loops)

    def __call__(self, before: Window, after: Window, scene: Scene) -> Window:
        """The window with its present relaxed; arguments as of `Corrector`."""
        present = after.present
        relaxed = relax(
            present,
            before.present,
            ~after.is_fluid,
            box=scene.box,
            particle_spacing=scene.particle_spacing,
            alpha=self.alpha,
            beta=self.beta,
            loops=self.loops,
        )
        if present.requires_grad:
            relaxed = scene.box.wrap(present + scene.box.displacement(relaxed, present.detach()))
        return replace(after, positions=torch.cat([after.positions[:-1], relaxed[None]]))
