"""What the budget of the trainings decided."""

from typing import Any

from cconv.report.plots import budget_chart
from cconv.report.sections.section import Records, Section
from cconv.study.records.summary import Summary


class BudgetSection(Section):
    """Errors of the finalists against updates and seconds, and what larger budgets brought."""

    name = "budget"
    title = "What the budget decided"
    part = "finalists"

    def draw(self, summary: Summary, records: Records) -> dict[str, Any]:
        """The curves of the finalists."""
        return {"chart": budget_chart(records.curves, summary)}
