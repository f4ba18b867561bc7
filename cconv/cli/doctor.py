"""`cconv doctor`: whether the installation and the machine are fit for studies, and what to do if not."""

from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING

import typer

from cconv.cli.console import print_json, results
from cconv.cli.options import AsJson

if TYPE_CHECKING:
    from cconv.study.installation import Checked

MARKS = {
    "ok": ("ok", "green"),
    "note": ("note", "blue"),
    "warning": ("warning", "yellow"),
    "problem": ("problem", "red"),
}


def doctor(as_json: AsJson = False) -> None:
    """Check the installation: packages, cores, memory, disk, temporary folder, GPU, extras, compiled loops and Ray.

    Each line says what was found, and what to do where something is wrong. The exit status is 1 if there is a problem.
    """
    from cconv.study.installation import examine

    found: list[Checked] = []
    for checked in examine(Path.cwd()):
        found.append(checked)
        if not as_json:
            _print(checked)
    if as_json:
        print_json([asdict(checked) for checked in found])
    if any(checked.state == "problem" for checked in found):
        raise typer.Exit(1)


def _print(checked: "Checked") -> None:
    word, style = MARKS[checked.state]
    advice = f" – {checked.advice}" if checked.advice else ""
    results.print(f"{word:8}", style=style, end="")
    results.print(f"{checked.name}: {checked.found}{advice}", soft_wrap=True)
