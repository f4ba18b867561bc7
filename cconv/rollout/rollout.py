"""The rollout: every answer of a model leads to the frame that the next one is asked about."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from typing import Any, Protocol

import torch
from torch import Tensor

from cconv.data.trajectory import Scene
from cconv.data.window import Window
from cconv.errors import CConvError, SimulationError
from cconv.rollout.correctors import Corrector, correctors_of
from cconv.tasks.integrators import Integrator
from cconv.tasks.task import as_step

FARTHEST_STEP = 10.0  # particle spacings in a frame; a particle that goes farther has left every flow behind
MOST_IN_A_CELL = 10  # particles in a cube of two spacings, as a multiple of those of the undisturbed fluid, 2^D


class StepModel(Protocol):
    """A model that answers for a window."""

    task: Any

    def predict_frame(self, frame: Window, scene: Scene) -> Tensor:
        """Answer (M, D) for each of the M fluid particles at the end of a window."""


class Diverged(CConvError):
    """A rollout that cannot go on: positions are not finite, leap, or clump so that a step would have no bound.

    Args:
        frame: Index of the frame that was to be reached.
        reason: What happened, as the end of a sentence.
    """

    def __init__(self, frame: int, reason: str):
        super().__init__(f"the rollout diverged at frame {frame}: {reason}.")
        self.frame, self.reason = frame, reason


def rollout(
    model: StepModel, start: Window, scene: Scene, *, correctors: Sequence[Corrector] | None = None
) -> Iterator[Window]:
    """Windows after a start, a frame later each, for as long as they are asked for.

    Args:
        model: Model of a step task, e.g. of `cconv.load_model`.
        start: The window to begin with, at least as long as the model's history.
        scene: Its scene.
        correctors: What corrects every frame, one after another, before the model is asked about it, e.g.
            `cconv.rollout.correctors.SPHRelaxation`; None takes those that belong to the model.

    Raises:
        ConfigError: If the model predicts a field.
        Diverged: If the next frame would not be a state of particles any more.
    """
    own = correctors_of(model) if correctors is None else correctors
    return advance(model.predict_frame, as_step(model.task).integrator, start, scene, correctors=own)


def advance(
    predict: Callable[[Window, Scene], Tensor],
    integrator: Integrator,
    start: Window,
    scene: Scene,
    *,
    correctors: Sequence[Corrector] = (),
) -> Iterator[Window]:
    """Windows after a start by any function that answers; `rollout` with the function of a model.

    Args:
        predict: Window and scene to the answer (M, D) for each of the M fluid particles.
        integrator: What turns an answer into the next frame.
        start: The window to begin with; its future is not looked at, unless `predict` does.
        scene: Its scene.
        correctors: What corrects every frame, one after another, before it is asked about.

    Raises:
        Diverged: If the next frame would not be a state of particles any more, or cannot be corrected.
    """
    window = replace(start, positions=start.positions.double())
    while True:
        before, window = window, integrator.advance(window, predict(window, scene), scene)
        check_state(window, scene)
        for corrector in correctors:
            window = _corrected(corrector, before, window, scene)
        yield window


def _corrected(corrector: Corrector, before: Window, after: Window, scene: Scene) -> Window:
    try:
        corrected = corrector(before, after, scene)
    except SimulationError as error:
        raise Diverged(after.frame, str(error).removesuffix(".")) from error
    check_state(corrected, scene)
    return corrected


@torch.no_grad()
def check_state(window: Window, scene: Scene) -> None:
    """Check that the present frame can be asked about: finite, without leaps, with a bounded number of neighbours.

    Raises:
        Diverged: With the reason.
    """
    present, spacing = window.present, scene.particle_spacing
    if not torch.isfinite(present).all():
        raise Diverged(window.frame, "positions are not finite")
    farthest = float(window.last_displacements(scene.box).norm(dim=1).max()) / spacing
    if farthest > FARTHEST_STEP:
        raise Diverged(window.frame, f"a particle moved {farthest:.3g} spacings in a frame")
    fullest = _most_in_a_cell(torch.floor(present.double() / (2 * spacing)).long())
    if fullest > MOST_IN_A_CELL * 2**scene.dim:
        raise Diverged(window.frame, f"{fullest} particles clumped within two spacings")


def _most_in_a_cell(cells: Tensor) -> int:
    """Largest number of points whose cells (N, D) are the same."""
    # Torch takes twenty times as long for rows as for a number of each cell. Only occupied places along an axis count:
    # with a particle far away, all cells would be too many to number.
    numbers = torch.zeros_like(cells[:, 0])
    for along in cells.unbind(dim=1):
        occupied, places = along.unique(return_inverse=True)
        numbers = numbers * len(occupied) + places
    return int(numbers.unique(return_counts=True)[1].max())
