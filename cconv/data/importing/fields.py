"""Finding positions, velocities, masses and the like among the arrays of a file, by usual names or by the user's."""

import re
from collections.abc import Mapping, Sequence

import numpy as np

from cconv.data.importing.table import Table
from cconv.data.limits import one_line
from cconv.errors import ConfigError, DataError, did_you_mean

# Usual names, lower-case letters and digits only, the likeliest first.
VECTORS = {
    "position": ("points", "position", "positions", "pos", "coordinates", "coords", "coord", "location", "p", "r", ""),
    "velocity": ("velocity", "velocities", "vel", "vels", "v", "u"),
    "normal": ("normal", "normals", "normaldirection", "boundarynormal", "boundarynormals"),
}
SCALARS = {
    "density": ("density", "densities", "rho", "rhop", "hydrodynamicdensity"),
    "mass": ("mass", "masses", "m"),
    "type": ("particletype", "particletypes", "type", "types", "ptype", "phase", "material", "kind", "mk"),
    "id": ("id", "ids", "particleid", "idp", "originalid", "globalid", "index", "gid"),
    "spacing": ("particlespacing", "dx"),
    "viscosity": ("kinematicviscosity", "nu"),
}
FIELDS = (*VECTORS, *SCALARS)
COMPONENTS = ("xyz", "012", "123")
VELOCITY_COLUMNS = ("u", "v", "w")
LARGEST = 3  # components of a vector


def parse_map(text: str) -> dict[str, tuple[str, ...]]:
    """Fields with the names that hold them, from text such as "velocity=vel,density=rho,position=a+b,id=".

    Raises:
        ConfigError: If an item has no "=", or a field is not known or stands there twice.
    """
    mapping: dict[str, tuple[str, ...]] = {}
    for item in text.split(","):
        name, equals, source = (part.strip() for part in item.partition("="))
        if not equals or name not in FIELDS or name in mapping:
            what = "stands there twice" if name in mapping else "is no field" if equals else "lacks a ="
            raise ConfigError(
                f"`--map` must be FIELD=NAME,...: {one_line(item, 40)!r} {what}.{did_you_mean(name, FIELDS)} "
                f"Fields: {', '.join(FIELDS)}."
            )
        mapping[name] = tuple(part.strip() for part in source.split("+") if part.strip())
    return mapping


def find_fields(table: Table, mapping: Mapping[str, Sequence[str]]) -> dict[str, tuple[str, ...]]:
    """Names of the arrays that hold each field, those that the user says first; columns of a vector one by one.

    Raises:
        DataError: If a name is not in the file, or there are no positions.
    """
    found = {field: names for field in FIELDS if (names := _usual(table, field)) and field not in mapping}
    for field, said in mapping.items():
        for name in said:
            if name not in table.arrays:
                known = one_line(", ".join(table.arrays))
                raise DataError(
                    f"{table.file}: has no {one_line(name, 40)!r} for the {field}."
                    f"{did_you_mean(name, table.arrays)} It has {known}."
                )
        if said:
            found[field] = tuple(said)
    if "position" not in found:
        known = one_line(", ".join(table.arrays)) or "nothing"
        raise DataError(f"{table.file}: has no positions among {known}; say what they are with --map position=NAME.")
    return found


def field_values(table: Table, field: str, names: Sequence[str]) -> np.ndarray:
    """Values of a field, (N, C) for a vector and (N,) for a scalar.

    Raises:
        DataError: If an array is missing, has no such shape or differs in length from the positions.
    """
    parts = [_array(table, name) for name in names]
    values = np.stack(parts, axis=1) if len(parts) > 1 and all(part.ndim == 1 for part in parts) else parts[0]
    if field in VECTORS:
        values = values[:, None] if values.ndim == 1 else values
        if values.ndim != 2 or not 1 <= values.shape[1] <= LARGEST:
            raise DataError(f"{table.file}: the {field} {_named(names)} must be (N, 1 to 3), got {values.shape}.")
    elif values.ndim != 1:
        raise DataError(
            f"{table.file}: the {field} {_named(names)} must be (N,), got {values.shape}; map another array."
        )
    return values


def _array(table: Table, name: str) -> np.ndarray:
    if name not in table.arrays:
        known = one_line(", ".join(table.arrays)) or "nothing"
        raise DataError(f"{table.file}: lacks {one_line(name, 40)!r}, which earlier files have (found: {known}).")
    return table.arrays[name]


def _named(names: Sequence[str]) -> str:
    return one_line("+".join(f"`{name}`" for name in names))


def _usual(table: Table, field: str) -> tuple[str, ...]:
    """Names of the arrays that are usually called like a field; empty if there are none."""
    plain: dict[str, str] = {}
    for name in table.arrays:
        plain.setdefault(re.sub(r"[^a-z0-9]", "", name.lower()), name)
    if field in SCALARS:
        return next(((plain[name],) for name in SCALARS[field] if _is_axis(table, plain.get(name), 1)), ())
    for base in VECTORS[field]:
        if _is_axis(table, plain.get(base), 2):
            return (plain[base],)
        for axes in COMPONENTS:
            columns = [plain.get(base + letter) for letter in axes if base or axes == "xyz"]
            names = tuple(name for name in columns if name is not None)
            if names and list(names) == columns[: len(names)] and all(_is_axis(table, name, 1) for name in names):
                return names
    letters = [plain[name] for name in VELOCITY_COLUMNS if name in plain] if field == "velocity" else []
    return tuple(letters) if len(letters) > 1 and letters[0] == plain.get("u") else ()


def _is_axis(table: Table, name: str | None, axes: int) -> bool:
    return name is not None and table.arrays[name].ndim == axes
