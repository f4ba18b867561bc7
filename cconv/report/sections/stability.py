"""Where the models fail: every check of every finalist."""

from typing import Any

from cconv.report.sections.section import Records, Section
from cconv.report.verdicts import verdict_matrix
from cconv.study.records.summary import Summary


class StabilitySection(Section):
    """Checks of the finalists, each with its limit."""

    name = "stability"
    title = "Stability"
    part = "finalists"

    def draw(self, summary: Summary, records: Records) -> dict[str, Any]:
        """A row a check."""
        return {"stability": verdict_matrix(summary)}
