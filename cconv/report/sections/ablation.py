"""The section on ablation: what each change between the baseline and the best model brings."""

from typing import Any

from cconv.report.plots import ablation_chart
from cconv.report.sections.section import Records, Section
from cconv.study.records.summary import Summary


class AblationSection(Section):
    """Show the models retrained with one change after the other, and with one feature removed or added."""

    name = "ablation"
    title = "Ablation"
    part = "ablation"

    def draw(self, summary: Summary, records: Records) -> dict[str, Any]:
        """Draw the errors along the path, if there is one."""
        has_path = summary.ablation is not None and summary.ablation.path
        return {"chart": ablation_chart(summary) if has_path else None}
