"""The command line: the only place that parses arguments and prints."""

import os
import re
import sys
from importlib.metadata import version
from typing import Annotated

import typer

from cconv.cli.console import INTERRUPTED, errors, results
from cconv.cli.data import app as data_app
from cconv.cli.doctor import doctor
from cconv.cli.export import export
from cconv.cli.imports import import_weights
from cconv.cli.model import evaluate, fit, report, train
from cconv.cli.rollout import rollout
from cconv.cli.study import app as study_app
from cconv.errors import CConvError, StudyError, is_disk_full, visible

_UNITS = {"bytes": 1, "KiB": 2**10, "MiB": 2**20, "GiB": 2**30}
_SIZE = rf"([\d.]+) ({'|'.join(_UNITS)})"

app = typer.Typer(
    name="cconv",
    rich_markup_mode="markdown",  # wraps paragraphs
    no_args_is_help=True,
    pretty_exceptions_enable=False,
)
app.add_typer(data_app, name="data")
app.add_typer(study_app, name="study")
for command in (train, fit, evaluate, rollout, export, report, doctor):
    app.command()(command)
app.command("import")(import_weights)


def _print_version(wanted: bool) -> None:
    if wanted:
        results.print(f"cconv {version('cconv')}")
        raise typer.Exit


@app.callback()
def _options(
    version: Annotated[
        bool, typer.Option("--version", callback=_print_version, is_eager=True, help="Show the version and exit.")
    ] = False,
) -> None:
    """Find the smallest, fastest continuous-convolution network that is accurate and stable enough for your fluid."""


def main() -> None:
    """Run the command line; bad input ends in one line on stderr and exit status 2, a study without a result in 1."""
    try:
        sys.exit(app(standalone_mode=False))
    except typer.TyperException as error:  # an unknown option or argument, or an impossible value
        if message := " ".join(error.format_message().split()):  # empty if help was asked for and printed
            context = getattr(error, "ctx", None)
            help_of = context.command_path if context else "cconv"
            _print_refusal(f"{message.rstrip('.')}; see {help_of} --help.")
        sys.exit(2)
    except CConvError as error:
        _print_refusal(str(error))
        sys.exit(1 if isinstance(error, StudyError) else 2)
    except BrokenPipeError:  # the reader of our output has stopped reading, as `head` does
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        sys.exit(1)
    except OSError as error:
        place = f"{error.filename}: " if error.filename else ""
        remedy = "; make room, then continue with `cconv study resume`" if is_disk_full(error) else ""
        _print_refusal(f"{place}{error.strerror or str(error) or type(error).__name__}{remedy}")
        sys.exit(2)
    except RuntimeError as error:
        if type(error).__name__ != "OutOfMemoryError":  # torch's, which is imported by then
            raise
        fits = fitting_share(str(error))
        fewer = "fewer particles at a time" if fits is None else f"at most about {fits:.0%} of the particles at a time"
        _print_refusal(f"{str(error).split('. ')[0]}; take a smaller network or {fewer}, or --device cpu")
        sys.exit(2)
    except KeyboardInterrupt:
        sys.exit(INTERRUPTED)


def fitting_share(message: str) -> float | None:
    """Share of the particles that would have fitted on a device, by torch's message that its memory is full.

    Memory grows with the number of particles: what was in use and what was asked for, together, would have to be no
    more than the device has. None where the message does not say so much.
    """
    sizes = re.search(rf"allocate {_SIZE}.*capacity of {_SIZE} of which {_SIZE} is free", message)
    if sizes is None:
        return None
    found = sizes.groups()
    asked, capacity, free = (float(found[place]) * _UNITS[found[place + 1]] for place in (0, 2, 4))
    return capacity / (capacity - free + asked)


def _print_refusal(reason: str) -> None:
    errors.print(visible(f"cconv: {reason}"), style="bold red", soft_wrap=True)
