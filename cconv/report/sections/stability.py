"""The section on stability: what every check found in every finalist."""

from itertools import groupby
from typing import Any

from cconv.report.sections.section import Records, Section
from cconv.report.verdicts import verdict_matrix
from cconv.study.records.summary import Summary


class StabilitySection(Section):
    """Show the findings of the checks in all finalists, each with its limit."""

    name = "stability"
    title = "Stability"
    part = "checks"

    def draw(self, summary: Summary, records: Records) -> dict[str, Any]:
        """Return the rows of each check, by its name."""
        rows = groupby(verdict_matrix(summary), key=lambda row: row.check)
        return {"rows_of": {check: list(found) for check, found in rows}}
