"""Prescribed motion: where particles go that no model moves, such as walls and lids."""

from torch import Tensor

from cconv.data.trajectory import Scene
from cconv.data.window import Window


def carried_on(window: Window, scene: Scene) -> Tensor:
    """Positions (N, D) of all particles a frame later if each repeats its last displacement, float64.

    So walls stay, and a lid that slides at a constant speed goes on, through periodic faces too.
    """
    before, now = window.positions[-2:].double()
    return scene.box.wrap(now + scene.box.displacement(now, before))
