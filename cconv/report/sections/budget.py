"""The section on the training budget: whether the errors still fell when it was used up."""

from typing import Any

from cconv.report.plots import budget_chart
from cconv.report.sections.section import Records, Section
from cconv.study.records.summary import Summary


class BudgetSection(Section):
    """Show the errors of the finalists against updates and seconds, and with larger budgets."""

    name = "budget"
    title = "Was the training budget large enough?"
    part = "finalists"

    def draw(self, summary: Summary, records: Records) -> dict[str, Any]:
        """Draw the learning curves of the finalists."""
        return {"chart": budget_chart(records.curves, [entry.id for entry in summary.finalists], summary.task.error)}
