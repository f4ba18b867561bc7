"""Functions are short and take few parameters; compiled loops, which can take no records of arrays, are exempt."""

import ast
from pathlib import Path

import pytest

PACKAGE = Path(__file__).parents[1] / "cconv"
MODULES = sorted(PACKAGE.rglob("*.py"))
MOST_PARAMETERS, MOST_LINES = 8, 45  # without `self`; without the docstring

EXEMPT = {
    # Its keywords are those of torch's and Open3D's layers, one by one.
    ("nn/continuous_conv.py", "ContinuousConv.__init__"),
    # Parameters of a command are its options.
    ("cli/data.py", "generate"),
    ("cli/data_import.py", "import_files"),
    ("cli/data.py", "show"),
    ("cli/model.py", "evaluate"),
    ("cli/rollout.py", "rollout"),
    ("cli/study.py", "run"),
    # Inputs of an exported program are plain tensors.
    ("models/exported.py", "PlainModel.forward"),
}


def functions(node, inside=()):
    """Names, with their classes', and nodes of all functions of a syntax tree, those inside others included."""
    for child in ast.iter_child_nodes(node):
        named = isinstance(child, ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef)
        names = (*inside, child.name) if named else inside
        if named and not isinstance(child, ast.ClassDef):
            yield ".".join(names), child
        yield from functions(child, names)


def is_compiled(function):
    """Whether numba compiles the function, told by the name that every module gives to its compiler."""
    return any(isinstance(each, ast.Name) and each.id == "_compile" for each in function.decorator_list)


def num_parameters(function):
    """Number of parameters without `self` and `cls`."""
    arguments = function.args
    names = {each.arg for each in (*arguments.posonlyargs, *arguments.args, *arguments.kwonlyargs)}
    return len(names - {"self", "cls"})


def num_lines(function):
    """Number of lines without the docstring."""
    first = function.body[0]
    prose = first.end_lineno - first.lineno + 1 if ast.get_docstring(function) is not None else 0
    return function.end_lineno - function.lineno + 1 - prose


def too_large(path):
    """Names of functions of a file with more parameters or lines than allowed."""
    return {
        (str(path.relative_to(PACKAGE)), name)
        for name, function in functions(ast.parse(path.read_text()))
        if not is_compiled(function)
        and (num_parameters(function) > MOST_PARAMETERS or num_lines(function) > MOST_LINES)
    }


@pytest.mark.parametrize("path", MODULES, ids=lambda path: str(path.relative_to(PACKAGE)))
def test_functions_are_short_and_take_few_parameters(path):
    assert too_large(path) <= EXEMPT


def test_what_is_exempt_is_too_large():
    assert set().union(*map(too_large, MODULES)) == EXEMPT
