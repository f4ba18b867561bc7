"""The finalists: errors, times and sizes in a table."""

from typing import Any

from cconv.report.sections.section import Records, Section
from cconv.report.tables import finalists_rows
from cconv.study.records.summary import Summary


class FinalistsSection(Section):
    """Show errors, times, sizes and hyperparameters of the finalists."""

    name = "finalists"
    title = "Finalists"
    part = "finalists"

    def draw(self, summary: Summary, records: Records) -> dict[str, Any]:
        """Return a row for each model, the mean predictor and the analytic field included."""
        reasons = dict.fromkeys(entry.test.why_no_interval for entry in summary.finalists)
        return {"rows": finalists_rows(summary), "why_no_interval": [reason for reason in reasons if reason]}
