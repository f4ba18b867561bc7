"""What the files of a folder define, so that none is forgotten in the folder's list."""

from importlib import import_module
from inspect import isabstract
from pathlib import Path

import cconv

PACKAGE = Path(cconv.__file__).parent


def registered(folder: str, base: type) -> set[type]:
    """Concrete classes of a kind that the modules of a folder of the package define for others."""
    found = set()
    for path in sorted((PACKAGE / folder).glob("*.py")):
        module = import_module(".".join(["cconv", *Path(folder).parts, path.stem]))
        classes = {value for value in vars(module).values() if isinstance(value, type) and issubclass(value, base)}
        own = {each for each in classes if each.__module__ == module.__name__ and not each.__name__.startswith("_")}
        found |= {each for each in own if not isabstract(each)}
    return found
