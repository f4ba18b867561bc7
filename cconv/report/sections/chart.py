"""The interactive chart of error against time per frame."""

from typing import Any

from cconv.report.interactive import interactive_html
from cconv.report.sections.section import Records, Section
from cconv.study.records.summary import Summary


class ChartSection(Section):
    """Show the error against the time per frame of the finalists and the trials."""

    name = "chart"
    title = "Speed and accuracy"
    part = "finalists"

    def draw(self, summary: Summary, records: Records) -> dict[str, Any]:
        """Draw the interactive chart as HTML."""
        return {"chart": interactive_html(summary)}
