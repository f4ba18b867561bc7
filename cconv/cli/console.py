"""How commands print: results on stdout, progress and errors on stderr."""

import json
from collections.abc import Iterable, Iterator

from rich.console import Console
from rich.progress import track

results = Console()
errors = Console(stderr=True)


def show_progress(items: Iterable, label: str) -> Iterator:
    """The items, with a progress bar on stderr while that is a terminal."""
    return iter(track(items, description=label, console=errors, transient=True, disable=not errors.is_terminal))


def print_json(value: object) -> None:
    """Print plain values as JSON that a program can read."""
    print(json.dumps(value, indent=2, allow_nan=False))
