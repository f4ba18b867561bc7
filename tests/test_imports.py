"""Imports point downwards only, between folders and between files, also those inside functions."""

import ast
from graphlib import TopologicalSorter
from pathlib import Path

import pytest

PACKAGE = Path(__file__).parents[1] / "cconv"

# A room, a folder or a file of the ground floor, imports from itself and from the tiers before its own.
TIERS = [
    {"errors", "compiled"},
    {"devices"},
    {"batching", "domain", "files", "forces", "cell_list", "tensor_cell_list"},
    {"validation", "neighbors"},
    {"ops"},
    {"sph"},
    {"nn"},
    {"networks", "scenes"},
    {"data"},
    {"tasks"},
    {"models"},
    {"rollout"},
    {"evaluation", "training"},
    {"study"},
    {"report"},
    {"cli"},
    {"__main__"},
]
STUDY_TIERS = [{"declared"}, {"records"}, {"evidence", "running"}, {"stages"}, {"studies"}, {"pipeline"}]
MODULES = sorted(path for path in PACKAGE.rglob("*.py") if path != PACKAGE / "__init__.py")
STUDY = [path for path in MODULES if path.is_relative_to(PACKAGE / "study") and path.parent != PACKAGE / "study"]
STUDY += [PACKAGE / "study" / "studies.py", PACKAGE / "study" / "pipeline.py"]
NUMERICS = [path for path in MODULES if path.relative_to(PACKAGE).parts[0] in {"sph", "nn", "ops"}]


def parts(path):
    """Names of a module below the package, e.g. ("study", "pipeline")."""
    names = path.relative_to(PACKAGE).with_suffix("").parts
    return names[:-1] if names[-1] == "__init__" else names


def is_module(name):
    """Whether a dotted name is a module of the package, and not what one defines."""
    place = PACKAGE.parent / name.replace(".", "/")
    return place.is_dir() or place.with_suffix(".py").is_file()


def imports(path):
    """Modules that a file imports anywhere in it, or names to `import_module`."""
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.ImportFrom):
            names = [f"{node.module}.{alias.name}" for alias in node.names]
            yield from (name if is_module(name) else node.module for name in names)
        elif isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.Constant) and str(node.value).startswith("cconv.") and " " not in node.value:
            yield node.value


def ours(path, depth):
    """Names of what a file imports of the package, so many levels deep."""
    names = (tuple(name.split(".")[1:]) for name in imports(path) if name.startswith("cconv."))
    return {name[depth - 1] for name in names if len(name) >= depth}


def allowed(tiers, room):
    """Rooms that a room may import from."""
    level = next(level for level, tier in enumerate(tiers) if room in tier)
    return {room}.union(*tiers[:level])


@pytest.mark.parametrize("path", MODULES, ids=lambda path: str(path.relative_to(PACKAGE)))
def test_a_module_imports_from_its_own_room_and_from_tiers_below(path):
    assert ours(path, 1) <= allowed(TIERS, parts(path)[0])


@pytest.mark.parametrize("path", STUDY, ids=lambda path: str(path.relative_to(PACKAGE)))
def test_a_module_of_the_study_imports_from_its_own_room_and_from_tiers_below(path):
    of_study = {name.split(".")[2] for name in imports(path) if name.startswith("cconv.study.")}
    assert of_study <= allowed(STUDY_TIERS, parts(path)[1])


def test_there_is_no_circle_between_files():
    files = {".".join(("cconv", *parts(path))): path for path in MODULES}
    TopologicalSorter({name: {*imports(path)} & files.keys() - {name} for name, path in files.items()}).prepare()


@pytest.mark.parametrize("room", ["declared", "records", "evidence"])
def test_declarations_records_and_evidence_use_neither_torch_nor_ray(room):
    paths = [path for path in STUDY if parts(path)[1] == room]
    used = {name.split(".")[0] for path in paths for name in imports(path)}
    assert paths
    assert not used & {"torch", "ray"}


@pytest.mark.parametrize("path", NUMERICS, ids=lambda path: str(path.relative_to(PACKAGE)))
def test_the_numeric_core_knows_no_files_or_terminal(path):
    outside = {name.split(".")[0] for name in imports(path)} - {"cconv"}
    assert not outside & {"pydantic", "json", "tomllib", "pathlib", "os", "rich", "typer", "ray", "h5py"}


@pytest.mark.parametrize("path", [path for path in MODULES if parts(path)[0] != "cli"], ids=str)
def test_only_the_command_line_prints(path):
    calls = (node.func for node in ast.walk(ast.parse(path.read_text())) if isinstance(node, ast.Call))
    assert not any(isinstance(function, ast.Name) and function.id == "print" for function in calls)
