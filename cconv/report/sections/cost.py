"""The section on the cost of predictions and trainings."""

from typing import Any

from cconv.report.plots import growth_chart
from cconv.report.sections.section import Records, Section
from cconv.report.tables import finalists_rows
from cconv.study.records.summary import Summary


class CostSection(Section):
    """Show the times of the finalists by part, and how they grow with the scene."""

    name = "cost"
    title = "Cost"
    part = "finalists"

    def draw(self, summary: Summary, records: Records) -> dict[str, Any]:
        """List the finalists, fastest first, and draw the growth of their times."""
        rows = [row for row in finalists_rows(summary) if row["entry"]]
        return {"rows": sorted(rows, key=lambda row: row["ms_per_frame"]), "growth": growth_chart(summary)}
