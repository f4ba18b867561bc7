"""What a section of the report is: where it applies, and what its template shows."""

from dataclasses import dataclass
from typing import Any, ClassVar

import pandas as pd

from cconv.report.tables import curves_table, trials_table
from cconv.study.records.run_folder import RunFolder
from cconv.study.records.summary import Summary


@dataclass(frozen=True, kw_only=True)
class Records:
    """What a run folder holds beside the summary, read once for all sections.

    Attributes:
        run: The folder.
        study: Its study file.
        space: Its search space.
        environment: Versions, seeds and data; None where the run ended before its data were read.
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
        """Whether a trial of a search was evaluated."""
        return not self.trials.empty and bool(self.trials["valid_error"].notna().any())


class Section:
    """A part of the page under a heading of its own.

    Attributes:
        name: Its anchor, and the name of its template in ``templates/sections/``.
        title: Its heading.
        part: The part of the summary that it shows: it applies where the summary holds it.
    """

    name: ClassVar[str]
    title: ClassVar[str]
    part: ClassVar[str]

    def applies(self, summary: Summary | None) -> bool:
        """Whether a run holds what the section shows; `summary` is None where the study has not finished."""
        return bool(getattr(summary, self.part, None))

    def draw(self, summary: Summary, records: Records) -> dict[str, Any]:
        """What the template shows beside the summary and the records, such as figures and rows; nothing by default."""
        return {}


class LastingSection(Section):
    """A section of every run, finished or not."""

    def applies(self, summary: Summary | None) -> bool:
        """Whether it stands in the page: always."""
        return True

    def draw(self, summary: Summary | None, records: Records) -> dict[str, Any]:
        """What the template shows beside them; `summary` is None where the study has not finished."""
        return {}
