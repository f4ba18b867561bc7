"""Rungs of ASHA: the errors of the trials that reached each rung, and which of them continue.

Source: Li et al., "A System for Massively Parallel Hyperparameter Tuning" (MLSys 2020), the stopping variant with one
bracket. Ray's own scheduler makes the same decisions, but loses its rungs when a run is restored.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from cconv.files import write_json
from cconv.study.records.forms import read_rungs
from cconv.study.records.summary import PassedRung


class RungTable:
    """Errors at each rung, in the order in which the trials reached it.

    Args:
        rungs: Updates of the rungs, ascending; the last one is the full budget, where no trial is stopped.
        reduction_factor: A trial continues if its error is in the best 1 / `reduction_factor` of those before it.
        recorded: Errors of an earlier run: for each rung a mapping of trials to errors.
    """

    def __init__(self, rungs: Sequence[int], reduction_factor: int, recorded: Sequence[Mapping[str, float]] = ()):
        self.rungs = list(rungs)
        self._quantile = 1 / reduction_factor
        self._recorded = [dict(errors) for errors in recorded] or [{} for _ in rungs]

    def record(self, trial: str, updates: int, error: float) -> bool:
        """Record an evaluation and return True if the trial continues; between rungs it always does.

        The first trial at a rung continues. A trial that was recorded before is compared with the same errors as the
        first time, so a killed run repeats its decisions.
        """
        if updates not in self.rungs:
            return True
        errors = self._recorded[self.rungs.index(updates)]
        error = errors.setdefault(trial, error)
        before = list(errors.values())[: list(errors).index(trial)]
        if updates == self.rungs[-1] or not before:
            return True
        return bool(error <= np.percentile(before, 100 * self._quantile))

    def passed(self) -> list[PassedRung]:
        """Count the trials that continued beyond each rung that was reached, except the last rung.

        More than 1 / `reduction_factor` of them do, because the first trial at a rung always continues, and the next
        ones are compared with few others.
        """
        return [
            PassedRung(
                updates=updates,
                trials=len(errors),
                passed=sum(self.record(trial, updates, error) for trial, error in errors.items()),
            )
            for updates, errors in zip(self.rungs[:-1], self._recorded, strict=False)
            if errors
        ]

    def entries(self) -> list[dict]:
        """Return one entry for each rung: "updates" and "recorded", its errors by trial."""
        return [
            {"updates": updates, "recorded": dict(errors)}
            for updates, errors in zip(self.rungs, self._recorded, strict=True)
        ]


class RungFile:
    """The rungs of all stages in one JSON file: ``{stage: [{"updates", "recorded"}]}``."""

    def __init__(self, path: Path):
        self._path = path

    def read(self) -> dict[str, list[dict]]:
        """Read the rungs of every stage that has any."""
        return read_rungs(self._path)

    def table(self, stage: str, rungs: Sequence[int], reduction_factor: int) -> RungTable:
        """Return the recorded table of a stage, or an empty one."""
        entries = {entry["updates"]: entry["recorded"] for entry in self.read().get(stage, [])}
        return RungTable(rungs, reduction_factor, [entries.get(updates, {}) for updates in rungs])

    def write(self, stage: str, table: RungTable) -> None:
        """Replace the rungs of a stage."""
        write_json(self._path, self.read() | {stage: table.entries()})
