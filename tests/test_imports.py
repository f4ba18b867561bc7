"""Imports point downwards only."""

import ast
from pathlib import Path

import pytest

PACKAGE = Path(__file__).parents[1] / "cconv"

# A module may import from its own tier and from those before it.
TIERS = [
    {"compiled", "errors"},
    {"files"},
    {"cell_list", "domain", "neighbors", "validation"},
    {"ops", "sph"},
    {"nn"},
    {"scenes", "data"},
    {"training", "evaluation"},
    {"study"},
    {"report"},
    {"cli"},
    {"__main__"},
]
LEVEL = {room: level for level, tier in enumerate(TIERS) for room in tier}
MODULES = sorted(path for path in PACKAGE.rglob("*.py") if path != PACKAGE / "__init__.py")
NUMERICS = [path for path in MODULES if path.relative_to(PACKAGE).parts[0] in {"sph", "nn", "ops"}]


def room(path):
    return path.relative_to(PACKAGE).with_suffix("").parts[0]


def imports(path):
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.ImportFrom):
            yield node.module
            if node.module == "cconv":
                yield from (f"cconv.{alias.name}" for alias in node.names)
        elif isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)


@pytest.mark.parametrize("path", MODULES, ids=lambda path: str(path.relative_to(PACKAGE)))
def test_a_module_imports_from_its_own_tier_and_below(path):
    ours = [name.split(".")[1] for name in imports(path) if name.startswith("cconv.")]
    assert all(LEVEL[name] <= LEVEL[room(path)] for name in ours)


@pytest.mark.parametrize("path", NUMERICS, ids=lambda path: str(path.relative_to(PACKAGE)))
def test_the_numeric_core_knows_no_settings_files_or_terminal(path):
    outside = {name.split(".")[0] for name in imports(path)} - {"cconv"}
    assert not outside & {"pydantic", "json", "tomllib", "pathlib", "os", "rich", "typer", "ray", "h5py"}


@pytest.mark.parametrize("path", [path for path in MODULES if room(path) != "cli"], ids=str)
def test_only_the_command_line_prints(path):
    calls = (node.func for node in ast.walk(ast.parse(path.read_text())) if isinstance(node, ast.Call))
    assert not any(isinstance(function, ast.Name) and function.id == "print" for function in calls)
