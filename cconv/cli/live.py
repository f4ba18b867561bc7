"""Progress of trials in the terminal: a live table, or plain lines without a terminal."""

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from rich.console import Console, Group
from rich.live import Live
from rich.progress import BarColumn, Progress
from rich.table import Table

from cconv.cli.console import plain_column, print_findings

if TYPE_CHECKING:
    from cconv.study.declared.configuration import TrainingConfig
    from cconv.training.loop import TrainingState

ROWS = 12


@dataclass
class _Row:
    parameters: Mapping
    began: float
    updates: int = 0
    error: float | None = None
    rate: float = 0.0
    outcome: str = "running"


@dataclass
class StudyDisplay:
    """Display of the trials of a study as they run; an `Observer` of `cconv.study.running.observer`.

    Attributes:
        console: Where to draw.
    """

    console: Console
    _rows: dict[str, _Row] = field(default_factory=dict)
    _stage: str = ""
    _num_trials: int = 0
    _began: float = 0.0
    _live: Live | None = None

    def __enter__(self) -> "StudyDisplay":
        if self.console.is_terminal:
            self._live = Live(console=self.console, get_renderable=self._draw, refresh_per_second=2, transient=True)
            self._live.start()
        return self

    def __exit__(self, *exception: object) -> None:
        if self._live is not None:
            self._live.stop()

    def on_data(self, findings: Sequence[str]) -> None:
        """Print a line for each implausibility of the data."""
        print_findings(findings, self.console)

    def on_stage(self, stage: str, num_trials: int, training: "TrainingConfig") -> None:
        """Begin a stage with an empty table."""
        self._stage, self._num_trials = stage, num_trials
        self._rows, self._began = {}, time.monotonic()
        self.console.print(f"{stage}: {num_trials} trainings of up to {training.budget}", style="bold")

    def on_trial_start(self, trial: str, parameters: Mapping) -> None:
        """Add a row."""
        self._rows[trial] = _Row(dict(parameters), time.monotonic())

    def on_trial_result(self, trial: str, entry: Mapping) -> None:
        """Update a row."""
        row = self._rows[trial]
        row.updates, row.error = entry["updates"], entry["valid_error"]
        row.rate = entry["updates"] / max(entry["seconds"], 1e-9)

    def on_trial_end(self, trial: str, outcome: str, reason: str) -> None:
        """Close a row; without a terminal, print it."""
        row = self._rows.setdefault(trial, _Row({}, time.monotonic()))
        row.outcome = outcome
        if self._live is None or outcome == "failed":
            ended = sum(other.outcome != "running" for other in self._rows.values())
            self.console.print(
                f"{self._stage} {ended}/{self._num_trials}  {trial}  {outcome} at {row.updates} updates, "
                f"error {_number(row.error)}, best {_number(self._best())}{self._time_left()}  {reason}".rstrip(),
                soft_wrap=True,
            )

    def _best(self) -> float | None:
        errors = [row.error for row in self._rows.values() if row.outcome == "completed" and row.error is not None]
        return min(errors, default=None)

    def _time_left(self) -> str:
        ended = sum(row.outcome != "running" for row in self._rows.values())
        if not ended or ended == self._num_trials:
            return ""
        seconds = (time.monotonic() - self._began) / ended * (self._num_trials - ended)
        return f", about {seconds / 60:.0f} min left in this stage" if seconds > 90 else f", about {seconds:.0f} s left"

    def _draw(self) -> Group:
        ended = sum(row.outcome != "running" for row in self._rows.values())
        head = f"{self._stage}: {ended} of {self._num_trials} ended, best {_number(self._best())}{self._time_left()}"
        return Group(head, self._table())

    def _table(self) -> Table:
        table = Table(box=None, pad_edge=False)
        for name in ("trial", "state", "updates", "updates/s", "error"):
            table.add_column(name, justify="left" if name in ("trial", "state") else "right")
        table.add_column("hyperparameters", overflow="ellipsis", no_wrap=True)
        running = [(name, row) for name, row in self._rows.items() if row.outcome == "running"]
        ended = [(name, row) for name, row in self._rows.items() if row.outcome != "running"]
        best = sorted(ended, key=lambda item: (-item[1].updates, item[1].error or float("inf")))
        for name, row in [*running, *best[: ROWS - len(running)]]:
            settings = " ".join(f"{key}={_short(value)}" for key, value in row.parameters.items())
            table.add_row(name, row.outcome, f"{row.updates}", f"{row.rate:.1f}", _number(row.error), settings)
        return table


class TrainingBar:
    """Progress of one training: updates, rate, loss, best error, time left; plain lines without a terminal.

    Args:
        console: Where to draw.
        name: Name of the training.
    """

    def __init__(self, console: Console, name: str):
        self._console = console
        self._best: float | None = None
        self._progress = Progress(
            plain_column("{task.description}"),
            BarColumn(),
            plain_column("{task.fields[figures]}"),
            console=console,
            disable=not console.is_terminal,
        )
        self._task = self._progress.add_task(name, total=1.0, figures="")

    def __enter__(self) -> "TrainingBar":
        self._progress.start()
        return self

    def __exit__(self, *exception: object) -> None:
        self._progress.stop()

    def on_update(self, state: "TrainingState") -> None:
        """Show the state of the training after an update."""
        valid = state.valid_error
        if valid is not None:
            self._best = valid if self._best is None else min(self._best, valid)
        rate = state.updates / state.seconds
        left = max(0.0, state.seconds * (1 / state.share - 1))
        errors = f"loss {state.train_loss:.3g}  best {_number(self._best)}"
        figures = f"{state.updates} updates  {rate:.1f}/s  {errors}  {left:.0f} s left"
        self._progress.update(self._task, completed=state.share, figures=figures)
        if valid is not None and not self._console.is_terminal:
            self._console.print(f"validation error {valid:.4g}, {figures}", soft_wrap=True)


def _number(value: float | None) -> str:
    return "–" if value is None else f"{value:.4g}"


def _short(value: object) -> str:
    return f"{value:.3g}" if isinstance(value, float) else str(value)
