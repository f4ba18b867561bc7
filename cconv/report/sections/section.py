"""The base classes of the sections of the report, and the records that they show."""

from dataclasses import dataclass
from typing import Any, ClassVar

import pandas as pd

from cconv.report.tables import curves_table, trials_table
from cconv.study.records.run_folder import RunFolder
from cconv.study.records.summary import Summary


@dataclass(frozen=True, kw_only=True)
class Records:
    """The records of a run folder beside the summary, read once for all sections.

    Attributes:
        run: The folder.
        study: Its study file.
        space: Its search space.
        environment: Versions, seeds and data; None if the run ended before its data were read.
        trials: `trials_table` of the run.
        curves: `curves_table` of the run.
    """

    run: RunFolder
    study: dict
    space: dict
    environment: dict | None
    trials: pd.DataFrame
    curves: pd.DataFrame

    @classmethod
    def read(cls, run: RunFolder) -> "Records":
        """Read the records of a run, finished or not."""
        has_environment = (run.path / "environment.json").is_file()
        return cls(
            run=run,
            study=run.read("study.json"),
            space=run.read("space.json"),
            environment=run.read("environment.json") if has_environment else None,
            trials=trials_table(run),
            curves=curves_table(run),
        )

    @property
    def has_errors(self) -> bool:
        """True if a trial of a search was evaluated."""
        return not self.trials.empty and bool(self.trials["valid_error"].notna().any())


class Section:
    """A part of the page under a heading of its own.

    Attributes:
        name: Its anchor, and the name of its template in ``templates/sections/``.
        title: Its heading.
        part: The part of the summary that it shows; the section is left out if the summary lacks it.
    """

    name: ClassVar[str]
    title: ClassVar[str]
    part: ClassVar[str]

    def applies(self, summary: Summary | None) -> bool:
        """Tell whether a run has the data of the section; `summary` is None if the study has not finished."""
        return bool(getattr(summary, self.part, None))

    def draw(self, summary: Summary, records: Records) -> dict[str, Any]:
        """Return what the template shows beside summary and records, such as figures and rows; by default nothing."""
        return {}


class LastingSection(Section):
    """A section that every run has, finished or not."""

    def applies(self, summary: Summary | None) -> bool:
        """Return True: the section is in every report."""
        return True

    def draw(self, summary: Summary | None, records: Records) -> dict[str, Any]:
        """Return what the template shows; `summary` is None if the study has not finished."""
        return {}
