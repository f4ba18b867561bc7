"""The scene that a data set was made with, found by what its metadata.json says."""

import math
from collections.abc import Mapping
from typing import Any, NamedTuple

import torch

from cconv.errors import ConfigError, shown
from cconv.scenes import SCENES
from cconv.scenes.simulated_scene import SimulatedScene

KEYS = {"particle_spacing": "dx", "viscosity": "viscosity", "time_step": "dt", "steps_per_frame": "write_every"}
MOST_STEPS = 1_000_000  # in a frame
MOST_CELLS = 10_000_000  # of a particle each in the box, before walls are laid out


class FoundScene(NamedTuple):
    """The result of `find_scene`.

    Attributes:
        scene: The scene with the settings of the data set, or None.
        reason: Why there is none, as the end of a sentence.
    """

    scene: SimulatedScene | None
    reason: str = ""


def find_scene(metadata: Mapping[str, Any]) -> FoundScene:
    """Find the scene of `SCENES` that a data set was made with: by its case and dimension, at the size of its box.

    Args:
        metadata: The content of metadata.json, LagrangeBench's or of `generate`.
    """
    case, dim = metadata.get("case"), metadata.get("dim")
    kinds = [kind for kind in SCENES.values() if (kind.case, kind.dim) == (case, dim)]
    if not kinds:
        return FoundScene(None, f"no scene has the case {shown(case)} in {shown(dim)} dimensions")
    settings = {name: metadata.get(key) for name, key in KEYS.items()}
    for name, value in settings.items():
        if not _is_setting(name, value):
            return FoundScene(None, f"`{KEYS[name]}` cannot be {shown(value)}")
    found = [_fitting(kind, {**size, **settings}, metadata) for kind in kinds for size in kind.sizes.values()]
    return next((each for each in found if each.scene), found[0])


def _is_setting(name: str, value: object) -> bool:
    if name == "steps_per_frame":
        return type(value) is int and 1 <= value <= MOST_STEPS
    return type(value) in (int, float) and 0 < value < 1e12  # type: ignore[operator]


def _fitting(kind: type[SimulatedScene], settings: Mapping[str, Any], metadata: Mapping[str, Any]) -> FoundScene:
    try:
        scene = kind(**settings)
        cells = math.prod(length / scene.particle_spacing for length in scene.box.lengths)
        if cells > MOST_CELLS:
            return FoundScene(None, f"{kind.name} would have {cells:.2g} cells of `dx`, more than {MOST_CELLS:,}")
        has_walls = len(scene.walls) > 0
    except ConfigError as error:
        return FoundScene(None, f"{kind.name} cannot have its settings ({error})")
    facts = {
        "density_evolution": scene.density_scheme == "evolution",
        "p_bg_factor": scene.background_pressure,
        "artificial_alpha": scene.artificial_viscosity,
        "g_ext_magnitude": scene.largest_force,
        "is_bc_trick": has_walls,
        "free_slip": False,
    }
    for key, value in facts.items():
        if metadata.get(key) not in (None, value):
            return FoundScene(None, f"`{key}` is {shown(metadata[key])}, and {value} in {kind.name}")
    if not _are_bounds(metadata.get("bounds"), scene):
        return FoundScene(None, f"{kind.name} does not have the bounds {shown(metadata.get('bounds'))}")
    return FoundScene(scene)


def _are_bounds(stored: Any, scene: SimulatedScene) -> bool:
    """Tell whether bounds are those of a scene, to a hundredth of the particle spacing."""
    try:
        bounds = torch.tensor(stored, dtype=torch.float64)
    except (TypeError, ValueError, RuntimeError, OverflowError):
        return False
    expected = torch.tensor([scene.box.lower, scene.box.upper], dtype=torch.float64).T
    return bounds.shape == expected.shape and bool(((bounds - expected).abs() <= 0.01 * scene.particle_spacing).all())
