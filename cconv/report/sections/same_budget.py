"""The section that compares ASHA with another stopping rule at the same budget."""

from typing import Any

from cconv.report.plots import strategies_chart
from cconv.report.sections.section import Records, Section
from cconv.study.records.summary import Summary


class SameBudgetSection(Section):
    """Show what each stopping rule found with the same number of gradient updates."""

    name = "same_budget"
    title = "Another stopping rule with the same budget"
    part = "references"

    def draw(self, summary: Summary, records: Records) -> dict[str, Any]:
        """Draw the best error of each rule against the updates spent."""
        return {"chart": strategies_chart(summary)}
