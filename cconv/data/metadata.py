"""metadata.json of the LagrangeBench layout: reading the facts of a scene from it, and writing them.

The key ``cconv`` keeps facts that the layout has no place for: name, force, where masses come from, what was missing.

Source: Toshev et al. (2023), LagrangeBench: A Lagrangian Fluid Mechanics Benchmarking Suite, and its data sets.
"""

import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, TypeGuard

from cconv.data.limits import one_line
from cconv.data.source import LARGEST, SMALLEST, STORED, Given
from cconv.data.trajectory import Scene
from cconv.domain import Box
from cconv.errors import ConfigError, DataError, ShapeError
from cconv.forces import ConstantForce, Force, ReversePoiseuilleForce, force_declared

METADATA = "metadata.json"
OWN_KEY = "cconv"
MOST_BYTES = 2**20
MOST_LINES = 50  # of what is missing
DIFFERENCES = "central differences of positions"
DAM_BREAK_CASES = ("db", "dam", "dam break")
REVERSE_POISEUILLE_CASES = ("rpf",)
OVERRIDES = {"mass": "masses", "particle_spacing": "particle spacing", "frame_dt": "frame dt", "force": "force"}


def load_metadata(file: Path) -> dict:
    """The JSON object in `file`.

    Raises:
        DataError: If it is not a JSON object.
    """
    if not file.is_file() or file.stat().st_size > MOST_BYTES:
        raise DataError(f"{file}: must be a file of at most {MOST_BYTES} bytes; correct it or copy it again.")
    try:
        metadata = json.loads(file.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError) as error:
        what = "nested too deeply" if isinstance(error, RecursionError) else one_line(error)
        raise DataError(f"{file}: is not valid JSON ({what}); correct it or copy it again.") from error
    if not isinstance(metadata, dict) or not isinstance(metadata.get(OWN_KEY, {}), dict):
        raise DataError(f"{file}: must be a JSON object, and so must its `{OWN_KEY}`; correct it or copy it again.")
    return metadata


def default_mass(particle_spacing: float, dim: int) -> float:
    """Return the mass of a particle if none is stored: rest density 1 times ``dx ** D``."""
    return particle_spacing**dim


def default_mass_source(particle_spacing: float, dim: int) -> str:
    """How `Scene.mass_source` tells that masses are `default_mass`."""
    return f"1 * dx^{dim} = {default_mass(particle_spacing, dim):g}"


def scene_from_metadata(
    metadata: Mapping, file: Path, given: Given, *, stores_velocity: bool, stores_mass: bool, has_boundary: bool
) -> Scene:
    """Build the scene from metadata.json, the members of the files and the user's values, which take precedence.

    Args:
        metadata: What is stored.
        file: Where, for messages; the scene is named after its folder unless it has a name.
        given: What the user says.
        stores_velocity: Whether velocities are stored.
        stores_mass: Whether masses are stored.
        has_boundary: Whether there are wall particles or boundary points.

    Raises:
        DataError: If a key is missing or its value cannot be.
        ConfigError: If the given force does not have one number an axis.
    """
    dim = _value(metadata, "dim", file, lambda value: type(value) is int and value in (1, 2, 3), "1, 2 or 3")
    spacing = given.particle_spacing or _positive(metadata, "dx", file)
    frame_dt = given.frame_dt or _frame_dt(metadata, file)
    own = metadata.get(OWN_KEY) or _deduced(metadata, file, dim, stores_velocity, stores_mass)
    mass_source = one_line(own.get("mass_source", STORED)) if stores_mass else default_mass_source(spacing, dim)
    force = given.force_in(dim) or _stored_force(own, file, dim)
    overridden = tuple(f"{topic}:" for name, topic in OVERRIDES.items() if getattr(given, name) is not None)
    missing = _own(own, "missing", file, lambda value: isinstance(value, list), "a list of lines") or []
    return Scene(
        name=one_line(own.get("name", file.parent.name)),
        dim=dim,
        particle_spacing=spacing,
        frame_dt=frame_dt,
        box=_box(metadata, dim, file),
        force=force,
        has_boundary=has_boundary,
        velocity_source=STORED if stores_velocity else DIFFERENCES,
        mass_source=f"given: {given.mass:g}" if given.mass else mass_source,
        missing=tuple(line for line in map(one_line, missing[:MOST_LINES]) if not line.startswith(overridden)),
    )


def metadata_from_scene(scene: Scene, stored: Mapping, statistics: Mapping) -> dict:
    """Build the metadata.json of a scene, complete for LagrangeBench.

    Args:
        scene: The scene.
        stored: What an earlier metadata.json of the data said (solver, viscosity, ...); kept where it still holds.
        statistics: Keys that follow from the trajectories: counts, lengths, mean and spread of steps.
    """
    keeps_steps = stored.get("dt", 0.0) * stored.get("write_every", 0) == scene.frame_dt
    return {
        "case": scene.name,
        "solver": None,
        "density_evolution": None,
        "viscosity": None,
        "t_end": statistics["sequence_length_train"] * scene.frame_dt,
        "p_bg_factor": None,
        "artificial_alpha": None,
        "free_slip": None,
        "is_bc_trick": False,
        "g_ext_magnitude": scene.force.largest if scene.force else 0.0,
        **stored,
        "dim": scene.dim,
        "dx": scene.particle_spacing,
        "dt": stored["dt"] if keeps_steps else scene.frame_dt,
        "write_every": stored["write_every"] if keeps_steps else 1,
        "periodic_boundary_conditions": list(scene.box.periodic),
        "bounds": [list(bounds) for bounds in zip(scene.box.lower, scene.box.upper, strict=True)],
        "default_connectivity_radius": float(f"{1.45 * scene.particle_spacing:.2g}"),
        **statistics,
        OWN_KEY: {
            **stored.get(OWN_KEY, {}),
            "name": scene.name,
            "force": scene.force.declaration() if scene.force else None,
            "mass_source": scene.mass_source,
            "missing": list(scene.missing),
        },
    }


def _deduced(metadata: Mapping, file: Path, dim: int, stores_velocity: bool, stores_mass: bool) -> dict:
    """What our key would hold for a LagrangeBench set, which has none: name, force and what is missing."""
    force, force_line = _external_force(metadata, file, dim)
    missing = {
        "frame dt": None if "write_every" in metadata else "`write_every` is not stored; frames are one `dt` apart",
        "velocities": None if stores_velocity else f"not stored; {DIFFERENCES}",
        "masses": None if stores_mass else f"not stored; rest density 1 times dx^{dim}",
        "force": force_line,
    }
    lines = [f"{topic}: {line}" for topic, line in missing.items() if line]
    return {"name": file.parent.name, "force": force, "missing": lines}


def _external_force(metadata: Mapping, file: Path, dim: int) -> tuple[dict | None, str | None]:
    """Declaration of the force that the case of a LagrangeBench set has, and what cannot be said about it."""
    magnitude = 0.0
    if metadata.get("g_ext_magnitude") is not None:
        magnitude = float(_value(metadata, "g_ext_magnitude", file, _is_number, f"a number of at most {LARGEST:g}"))
    case = str(metadata.get("case", "")).lower()
    if magnitude and case in DAM_BREAK_CASES and dim > 1:
        down = tuple(-magnitude if axis == 1 else 0.0 for axis in range(dim))
        return ConstantForce(down).declaration(), None
    if magnitude and case in REVERSE_POISEUILLE_CASES and dim > 1:
        return ReversePoiseuilleForce(magnitude, _box(metadata, dim, file).lengths[1]).declaration(), None
    if magnitude:
        return None, f"of magnitude {magnitude:g} acts, but its direction is not stored (it may depend on position)"
    if (file.parent / "force.py").exists():
        return None, "given by force.py, which is never run"
    return None, None


def _stored_force(own: Mapping, file: Path, dim: int) -> Force | None:
    """The force that our key declares, or None."""
    if own.get("force") is None:
        return None
    try:
        return force_declared(own["force"], dim)
    except ConfigError as error:
        raise DataError(f"{file}: `{OWN_KEY}.force`: {error}; correct it.") from error


def _box(metadata: Mapping, dim: int, file: Path) -> Box:
    """Bounds and periodic axes; LagrangeBench stores three periodic flags even in 2D."""
    bounds = _value(metadata, "bounds", file, lambda value: _is_bounds(value, dim), f"{dim} pairs [lower, upper]")
    periodic = _value(
        metadata,
        "periodic_boundary_conditions",
        file,
        lambda value: isinstance(value, list) and len(value) >= dim and all(type(flag) is bool for flag in value),
        f"at least {dim} truth values (true or false)",
    )
    try:
        return Box([low for low, _ in bounds], [high for _, high in bounds], periodic[:dim])
    except ShapeError as error:
        raise DataError(f"{file}: `bounds`: {error}") from error


def _value(metadata: Mapping, key: str, file: Path, fits: Callable[[object], bool], wanted: str) -> Any:
    if key not in metadata:
        raise DataError(f"{file}: key `{key}` is missing; add it ({wanted}).")
    if not fits(metadata[key]):
        raise DataError(f"{file}: `{key}` must be {wanted}, got {one_line(repr(metadata[key]))}; correct it.")
    return metadata[key]


def _own(own: Mapping, key: str, file: Path, fits: Callable[[object], bool], wanted: str) -> Any:
    if own.get(key) is None:
        return None
    if not fits(own[key]):
        raise DataError(f"{file}: `{OWN_KEY}.{key}` must be {wanted}, got {one_line(repr(own[key]))}; correct it.")
    return own[key]


def _frame_dt(metadata: Mapping, file: Path) -> float:
    steps = _positive(metadata, "write_every", file) if "write_every" in metadata else 1.0
    frame_dt = _positive(metadata, "dt", file) * steps
    if not SMALLEST <= frame_dt <= LARGEST:
        raise DataError(f"{file}: `dt` times `write_every` must be {SMALLEST:g} to {LARGEST:g}, got {frame_dt:g}.")
    return frame_dt


def _positive(metadata: Mapping, key: str, file: Path) -> float:
    wanted = f"a positive number from {SMALLEST:g} to {LARGEST:g}"
    return float(_value(metadata, key, file, lambda value: _is_number(value) and value >= SMALLEST, wanted))


def _is_number(value: object) -> TypeGuard[float]:
    return isinstance(value, int | float) and not isinstance(value, bool) and abs(value) <= LARGEST


def _is_vector(value: object, length: int) -> bool:
    return isinstance(value, list) and len(value) == length and all(map(_is_number, value))


def _is_bounds(value: object, dim: int) -> bool:
    return isinstance(value, list) and len(value) == dim and all(_is_vector(pair, 2) for pair in value)
