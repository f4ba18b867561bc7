"""Whether a trial may be stopped at a rung."""

from typing import Any

from cconv.report.plots import rung_audit_chart
from cconv.report.sections.section import Records, Section
from cconv.study.records.summary import Summary


class RungsSection(Section):
    """How well the order of the trials at a rung predicts the order at the end."""

    name = "rungs"
    title = "May a trial be stopped at a rung?"
    part = "rung_audit"

    def draw(self, summary: Summary, records: Records) -> dict[str, Any]:
        """The measures of the audit by rung."""
        return {"chart": rung_audit_chart(summary)}
