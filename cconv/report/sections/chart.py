"""The chart of the study: error against time per frame, to hover over."""

from typing import Any

from cconv.report.interactive import interactive_html
from cconv.report.sections.section import Records, Section
from cconv.study.records.summary import Summary


class ChartSection(Section):
    """Error against time per frame of finalists and search."""

    name = "chart"
    title = "Speed and accuracy"
    part = "finalists"

    def draw(self, summary: Summary, records: Records) -> dict[str, Any]:
        """The interactive chart as HTML."""
        return {"chart": interactive_html(summary)}
