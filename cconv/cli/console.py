"""The consoles of the commands: results go to stdout, progress and errors to stderr."""

import json
from collections.abc import Iterable, Iterator, Mapping
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeRemainingColumn
from rich.table import Table
from rich.text import Text

from cconv.errors import visible

INTERRUPTED = 130  # exit status after Ctrl-C


class PlainConsole(Console):
    """A console that shows strings as they are, in tables and live displays too.

    Names and reasons come from foreign files. So no string is read as markup or as the name of an emoji, and control
    characters are written as escapes. To print with a style, pass a `Text`.
    """

    def __init__(self, **options: Any):
        super().__init__(markup=False, emoji=False, highlight=False, **options)

    def render_str(self, text: str, **options: Any) -> Text:
        """The string as a `Text`, its lines kept."""
        plain = "\n".join(visible(line) for line in text.split("\n"))
        return super().render_str(plain, **options | {"markup": False, "emoji": False})


results = PlainConsole()
errors = PlainConsole(stderr=True)


def plain_column(text: str) -> TextColumn:
    """Make a column of a progress display that shows its fields as they are."""
    return TextColumn(text, markup=False)


def show_progress(items: Iterable, label: str) -> Iterator:
    """Yield the items and show a progress bar on stderr if that is a terminal."""
    columns = (plain_column("{task.description}"), BarColumn(), TaskProgressColumn(), TimeRemainingColumn())
    with Progress(*columns, console=errors, transient=True, disable=not errors.is_terminal) as progress:
        yield from progress.track(items, description=visible(label))


def print_findings(findings: Iterable, console: Console = errors) -> None:
    """Print a line for each implausibility of the data."""
    for finding in findings:
        console.print(f"cconv: suspicious data: {finding}", style="yellow", soft_wrap=True)


def print_json(value: object) -> None:
    """Print plain values as JSON that a program can read."""
    print(json.dumps(value, indent=2, allow_nan=False))


def plain_table(title: str, rows: Mapping[str, str]) -> Table:
    """Make a table of rows with a name and a value each, whose strings are shown as they are."""
    table = Table(title=Text(title), show_header=False, title_justify="left")
    table.add_column(style="bold", no_wrap=True)
    table.add_column(overflow="fold")
    for label, text in rows.items():
        table.add_row(label, Text(text))  # names and sources come from the data: read no markup in them
    return table
