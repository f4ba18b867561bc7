"""The rollout: every answer of a model leads to the frame that the next one is asked about."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import partial
from typing import Any, Protocol

import torch
from torch import Tensor

from cconv.batching import largest_of_windows
from cconv.data.trajectory import Scene
from cconv.data.window import Window, join_windows
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
    window = begun(start)
    while True:
        window, (end,) = followed(predict, integrator, window, scene, correctors)
        if end is not None:
            raise end
        yield window


def begun(start: Window) -> Window:
    """The window that a rollout begins with, in float64."""
    return replace(start, positions=start.positions.double())


def followed(
    predict: Callable[[Window, Scene], Tensor],
    integrator: Integrator,
    window: Window,
    scene: Scene,
    correctors: Sequence[Corrector] = (),
) -> tuple[Window, list[Diverged | None]]:
    """The window a frame later, or several that are joined.

    Args:
        predict: Window and scene to the answer (M, D) for each of the M fluid particles.
        integrator: What turns an answer into the next frame.
        window: One window or several.
        scene: Their scene.
        correctors: What corrects every frame, one after another.

    Returns:
        What follows, and of each window why nothing can follow any more; None where it can. Whoever goes on leaves the
        former out (`Window.only`): their particles may be anywhere, so that a search for neighbours has no bound.
    """
    following = integrator.advance(window, predict(window, scene), scene)
    ends = find_ends(following, scene)
    if not correctors:
        return following, ends
    parts = zip(window.separated(), following.separated(), ends, strict=True)
    corrected = [_corrected(correctors, before, after, scene, end) for before, after, end in parts]
    return join_windows([after for after, _ in corrected]), [end for _, end in corrected]


def _corrected(
    correctors: Sequence[Corrector], before: Window, after: Window, scene: Scene, end: Diverged | None
) -> tuple[Window, Diverged | None]:
    """A single window after correction, and why nothing can follow any more."""
    for corrector in correctors:
        if end is None:
            try:
                after = corrector(before, after, scene)
            except SimulationError as error:
                end = Diverged(after.frame, str(error).removesuffix("."))
                end.__cause__ = error
            else:
                (end,) = find_ends(after, scene)
    return after, end


@torch.no_grad()
def find_ends(window: Window, scene: Scene) -> list[Diverged | None]:
    """Find the windows, among one or several joined, that cannot be asked about.

    Their present frame must be finite, without leaps, with a bounded number of neighbours.

    Returns:
        Why each cannot be asked about; None where it can.
    """
    present, origins = window.present, window.origins
    index = window.batch_index
    if index is None:
        index = torch.zeros(len(present), dtype=torch.int64, device=present.device)
    steps = window.last_displacements(scene.box).norm(dim=1) / scene.particle_spacing
    cells = torch.floor(present.double() / (2 * scene.particle_spacing)).long()
    broken = largest_of_windows((~torch.isfinite(present)).any(dim=1).long(), index, len(origins))
    farthest = largest_of_windows(steps, index, len(origins))
    fullest = _most_in_a_cell(cells, index, len(origins))
    reasons = map(partial(_reason, dim=scene.dim), broken, farthest, fullest)
    found = zip(origins, reasons, strict=True)
    return [None if reason is None else Diverged(origin.frame, reason) for origin, reason in found]


def _reason(broken: int, farthest: float, fullest: int, dim: int) -> str | None:
    """Why a window cannot be asked about; None if it can."""
    if broken:
        return "positions are not finite"
    if farthest > FARTHEST_STEP:
        return f"a particle moved {farthest:.3g} spacings in a frame"
    if fullest > MOST_IN_A_CELL * 2**dim:
        return f"{fullest} particles clumped within two spacings"
    return None


def _most_in_a_cell(cells: Tensor, batch_index: Tensor, windows: int) -> list[int]:
    """Largest number of points of each of so many windows whose cells (N, D) are the same."""
    # Torch takes twenty times as long for rows as for a number of each cell. Only occupied places along an axis count:
    # with a particle far away, all cells would be too many to number.
    numbers, cells_of_window = batch_index, 1
    for along in cells.unbind(dim=1):
        occupied, places = along.unique(return_inverse=True)
        numbers = numbers * len(occupied) + places
        cells_of_window *= len(occupied)
    found, counts = numbers.unique(return_counts=True)
    return largest_of_windows(counts, found // cells_of_window, windows)
