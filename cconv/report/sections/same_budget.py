"""ASHA beside another rule for stopping trials, at the same budget."""

from typing import Any

from cconv.report.plots import strategies_chart
from cconv.report.sections.section import Records, Section
from cconv.study.records.summary import Summary


class SameBudgetSection(Section):
    """What each rule for stopping trials found with the same number of gradient updates."""

    name = "same_budget"
    title = "The same budget, spent by another rule"
    part = "references"

    def draw(self, summary: Summary, records: Records) -> dict[str, Any]:
        """The best error of each rule against the updates spent."""
        return {"chart": strategies_chart(summary)}
