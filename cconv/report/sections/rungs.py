"""The audit of the rungs: whether early stopping drops good trials there."""

from typing import Any

from cconv.report.plots import rung_audit_chart
from cconv.report.sections.section import Records, Section
from cconv.study.records.summary import Summary


class RungsSection(Section):
    """Show how well the order of the trials at a rung predicts their order after the full budget."""

    name = "rungs"
    title = "Does early stopping drop good trials?"
    part = "rung_audit"

    def draw(self, summary: Summary, records: Records) -> dict[str, Any]:
        """Draw the measures of the audit by rung."""
        return {"chart": rung_audit_chart(summary)}
