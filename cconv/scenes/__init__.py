"""Scenes of fluid dynamics: particles, walls, forces, solver settings and features."""

import math
from typing import Any

from cconv.errors import check_choice
from cconv.scenes.cuboid_3d import Cuboid3D
from cconv.scenes.dam_break_2d import DamBreak2D
from cconv.scenes.free_drop_2d import FreeDrop2D
from cconv.scenes.lid_driven_cavity import LidDrivenCavity2D, LidDrivenCavity3D
from cconv.scenes.reverse_poiseuille import ReversePoiseuille2D, ReversePoiseuille3D
from cconv.scenes.simulated_scene import SimulatedScene
from cconv.scenes.taylor_green import TaylorGreen2D, TaylorGreen3D
from cconv.scenes.water_column_2d import WaterColumn2D

SCENES: dict[str, type[SimulatedScene]] = {
    scene.name: scene
    for scene in (
        TaylorGreen2D,
        TaylorGreen3D,
        ReversePoiseuille2D,
        ReversePoiseuille3D,
        LidDrivenCavity2D,
        LidDrivenCavity3D,
        DamBreak2D,
        Cuboid3D,
        WaterColumn2D,
        FreeDrop2D,
    )
}


def scene_named(name: str, size: str = "published", **settings: Any) -> SimulatedScene:
    """A scene at one of its sizes.

    Args:
        name: Key of `SCENES`.
        size: "published" or "small".
        **settings: Settings to replace, such as `viscosity`; None keeps the size's own.

    Raises:
        ConfigError: If there is no such scene or size, or a setting is impossible.
    """
    check_choice("scene", name, SCENES)
    scene = SCENES[name]
    check_choice("size", size, scene.sizes)
    given = {key: value for key, value in settings.items() if value is not None}
    if given.keys() & {"particle_spacing", "viscosity"}:
        given.setdefault("time_step", math.inf)  # the size's own belongs to its own spacing and viscosity
    return scene(**{**scene.sizes[size], **given})
