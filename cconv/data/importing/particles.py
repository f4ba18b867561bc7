"""Particles of one frame, put together from the files of its bodies: fluid, further phases, walls."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from cconv.data.importing.fields import field_values
from cconv.data.importing.table import Table
from cconv.data.limits import one_line
from cconv.data.source import LARGEST
from cconv.data.trajectory import ParticleType
from cconv.errors import ConfigError, DataError

KINDS = {
    "fluid": ParticleType.FLUID,
    "wall": ParticleType.SOLID_WALL,
    "moving": ParticleType.MOVING_WALL,
    "rigid": ParticleType.MOVING_WALL,
    "drop": None,
}
OF_LAGRANGEBENCH = {0: ParticleType.FLUID, 1: ParticleType.SOLID_WALL, 2: ParticleType.MOVING_WALL}
OF_LAGRANGEBENCH |= {3: ParticleType.MOVING_WALL}
OWN_NAMES = ("particle_type", "particle_types")  # of types that mean what LagrangeBench's do
Types = Mapping[int, ParticleType | None]


@dataclass(frozen=True, kw_only=True)
class Particles:
    """Particles of one frame, sorted by their ids where they have any.

    Attributes:
        file: Where they come from.
        positions: (N, C).
        types: (N,), values of `ParticleType`.
        ids: (N,), or None.
        values: Further fields by name, (N, C) or (N,).
    """

    file: Path
    positions: np.ndarray
    types: np.ndarray
    ids: np.ndarray | None
    values: dict[str, np.ndarray]

    def __len__(self) -> int:
        return len(self.positions)


def parse_types(text: str) -> dict[int, ParticleType | None]:
    """What values of the type mean, from text such as "0=fluid,1=wall,9=drop"; None for what is left out.

    Raises:
        ConfigError: If an item is not NUMBER=KIND.
    """
    types = {}
    for item in text.split(","):
        value, _, kind = (part.strip() for part in item.partition("="))
        if not value.removeprefix("-").isdigit() or kind not in KINDS:
            raise ConfigError(
                f"`--types` must be NUMBER=KIND,..., got {one_line(item, 40)!r}; kinds are {', '.join(KINDS)}."
            )
        types[int(value)] = KINDS[kind]
    return types


def particles_of(
    table: Table, fields: Mapping[str, Sequence[str]], types: Types | None, fluid: int | None
) -> Particles:
    """The particles of a file, without those that are to be left out.

    Args:
        table: What the file holds.
        fields: Names of the arrays of each field.
        types: Meaning of the values of the type; None for what they usually mean.
        fluid: Number of fluid particles, which come first, with moving walls after them; None if types tell.

    Raises:
        DataError: If a field is missing, of another length, has a NaN, or has types of unknown meaning.
    """
    values = {field: field_values(table, field, names) for field, names in fields.items()}
    count = len(values["position"])
    for field, each in values.items():
        if len(each) != count:
            raise DataError(
                f"{table.file}: the {field} has {len(each)} rows, the position {count}; write the file again, or leave "
                f"the field out with --map {field}="
            )
        if each.dtype.kind == "f" and not (np.abs(each.astype(np.float64)) <= LARGEST).all():
            row = int(np.argmin((np.abs(each.astype(np.float64)) <= LARGEST).reshape(count, -1).all(axis=1)))
            raise DataError(
                f"{table.file}: the {field} of particle {row} is a NaN or beyond {LARGEST:g}; the simulation blew up: "
                "leave out this file and those after it."
            )
    kinds = _kinds(table, values.pop("type", None), fields.get("type", ()), types, fluid, count)
    ids = values.pop("id", None)
    is_unique = ids is not None and len(np.unique(ids)) == count
    order = np.argsort(ids, kind="stable") if ids is not None and is_unique else np.arange(count)
    order = order[kinds[order] != ParticleType.PAD]
    if len(order) == 0:
        raise DataError(f"{table.file}: no particle is left of its {count}; correct --types.")
    return Particles(
        file=table.file,
        positions=values.pop("position")[order],
        types=kinds[order],
        ids=ids[order] if ids is not None and is_unique else None,
        values={field: each[order] for field, each in values.items()},
    )


def joined(parts: Sequence[Particles]) -> Particles:
    """Particles of several bodies as one; fields that one of them lacks are left out, ids too.

    Raises:
        DataError: If they have different numbers of dimensions.
    """
    first = parts[0]
    if len(parts) == 1:
        return first
    for part in parts:
        if part.positions.shape[1] != first.positions.shape[1]:
            raise DataError(
                f"{part.file}: has {part.positions.shape[1]} dimensions, {first.file.name} has "
                f"{first.positions.shape[1]}; write both with as many."
            )
    shared = [name for name in first.values if all(name in part.values for part in parts)]
    ids = [part.ids for part in parts if part.ids is not None]
    return Particles(
        file=first.file,
        positions=np.concatenate([part.positions for part in parts]),
        types=np.concatenate([part.types for part in parts]),
        ids=_told_apart(ids) if len(ids) == len(parts) else None,
        values={name: np.concatenate([part.values[name] for part in parts]) for name in shared},
    )


def _told_apart(ids: Sequence[np.ndarray]) -> np.ndarray:
    """Ids of several bodies, shifted so that no two bodies share one."""
    shift, told = 0, []
    for each in ids:
        told.append(each.astype(np.int64) - int(each.min()) + shift)
        shift = int(told[-1].max()) + 1
    return np.concatenate(told)


def _kinds(
    table: Table,
    stored: np.ndarray | None,
    names: Sequence[str],
    types: Types | None,
    fluid: int | None,
    count: int,
) -> np.ndarray:
    """Values of `ParticleType`, (N,); `PAD` for what is left out."""
    if fluid is not None:
        if fluid > count:
            raise DataError(f"{table.file}: has {count} particles, fewer than the {fluid} that are to be fluid.")
        return np.where(np.arange(count) < fluid, int(ParticleType.FLUID), int(ParticleType.MOVING_WALL))
    if stored is None:
        return np.full(count, int(ParticleType.FLUID))
    known, counts = np.unique(stored, return_counts=True)
    meanings = types if types is not None else OF_LAGRANGEBENCH if names[0].lower() in OWN_NAMES else {}
    if not meanings and len(known) == 1:
        return np.full(count, int(ParticleType.FLUID))
    unknown = [value for value in known.tolist() if value not in meanings]
    if unknown:
        listed = ", ".join(f"{value:g} ({number})" for value, number in zip(known.tolist()[:10], counts, strict=False))
        raise DataError(
            f"{table.file}: {one_line(names[0], 40)!r} has the values {listed}; say what {unknown[0]:g} means, such as "
            f"--types {unknown[0]:g}=fluid (kinds: {', '.join(KINDS)}), or ignore it with --map type="
        )
    kinds = np.full(count, int(ParticleType.PAD))
    for value, kind in meanings.items():
        if kind is not None:
            kinds[stored == value] = int(kind)
    return kinds
