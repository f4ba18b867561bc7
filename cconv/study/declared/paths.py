"""Paths into a study file, such as `network.kernel_size`: they are the names of hyperparameters."""

from collections.abc import Callable, Mapping
from typing import TypeGuard, TypeVar

Each = TypeVar("Each")


def is_table(value: object) -> TypeGuard[Mapping[str, object]]:
    """Whether a value is a table of a file."""
    return isinstance(value, Mapping)


def is_table_of_tables(value: object) -> TypeGuard[Mapping[str, object]]:
    """Whether a value is a table that holds nothing but tables."""
    return isinstance(value, Mapping) and bool(value) and all(map(is_table, value.values()))


def by_path(
    tables: Mapping[str, object], goes_on: Callable[[object], TypeGuard[Mapping[str, object]]] = is_table
) -> dict[str, object]:
    """Values of nested tables by their paths; a path may also be written as one quoted key.

    Args:
        tables: Tables as a file has them, e.g. ``{"network": {"layers": 1}}``, which is ``{"network.layers": 1}``.
        goes_on: Whether the path leads on into a value.

    Raises:
        ValueError: If a path leads to two values.
    """
    values: dict[str, object] = {}
    for name, value in tables.items():
        found = {name: value}
        if goes_on(value):
            found = {f"{name}.{path}": each for path, each in by_path(value, goes_on).items()}
        if twice := values.keys() & found.keys():
            raise ValueError(f"`{min(twice)}` is given twice")
        values |= found
    return values


def paths_of_tables(value: object, goes_on: Callable[[object], TypeGuard[Mapping[str, object]]] = is_table) -> object:
    """Values by their paths, as `by_path`, of what should be tables; anything else as it is, for its form to refuse."""
    return by_path(value, goes_on) if is_table(value) else value


def below(table: str, values: Mapping[str, Each]) -> dict[str, Each]:
    """The values whose paths lead into a table, by the rest of the path."""
    return {path.removeprefix(f"{table}."): each for path, each in values.items() if path.startswith(f"{table}.")}
