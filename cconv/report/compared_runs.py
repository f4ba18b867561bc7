"""Finished studies that are compared: their summaries, and what else of their records a comparison needs."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from cconv.errors import ConfigError
from cconv.files import read_json
from cconv.study.records.forms import Count
from cconv.study.records.rollouts import FinalistRollouts, read_rollouts
from cconv.study.records.run_folder import RunFolder
from cconv.study.records.summary import FinalistEntry, Summary
from cconv.validation import Name, OpenModel, validated


class Inputs(OpenModel):
    """What a checkpoint's `config.json` says of the inputs of a model; nothing if the checkpoint is gone."""

    history: Count | None = None
    features: tuple[Name, ...] = ()


@dataclass(frozen=True, kw_only=True)
class ComparedRun:
    """A finished study among those that are compared.

    Attributes:
        label: Its name, with its folder where two studies have one name.
        summary: Its results.
        inputs: Inputs of the recommended model.
        rollouts: Rollouts of the finalists over whole test trajectories, by their ids; empty for a field.
    """

    label: str
    summary: Summary
    inputs: Inputs
    rollouts: Mapping[str, FinalistRollouts] = field(default_factory=dict)

    @property
    def chosen(self) -> FinalistEntry:
        """The recommended finalist."""
        return self.summary.chosen


def compared_runs(runs: Sequence[RunFolder]) -> list[ComparedRun]:
    """Read the results of finished studies.

    Raises:
        ConfigError: If one is given twice, or one has not finished.
        DataError: If the records of a study are damaged.
    """
    paths = [run.path.resolve() for run in runs]
    twice = [path for path in paths if paths.count(path) > 1]
    if twice:
        raise ConfigError(f"{twice[0]} is given twice; name each run folder once.")
    unfinished = [run.path for run in runs if not run.has_summary]
    if unfinished:
        raise ConfigError(
            f"{unfinished[0]}: the study has not finished, so it has no answer to compare; go on with it by "
            f"`cconv study resume {unfinished[0]}`."
        )
    summaries = [run.summary() for run in runs]
    names = [summary.study for summary in summaries]
    return [
        ComparedRun(
            label=summary.study if names.count(summary.study) == 1 else f"{summary.study} ({run.path})",
            summary=summary,
            inputs=_read_inputs(run.path / summary.chosen.checkpoint / "config.json"),
            rollouts=read_rollouts(run, summary.rolled),
        )
        for run, summary in zip(runs, summaries, strict=True)
    ]


def _read_inputs(path: Path) -> Inputs:
    return validated(Inputs, read_json(path, error=ConfigError), path) if path.exists() else Inputs()
