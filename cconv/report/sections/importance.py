"""The section on importance: how much each hyperparameter influences the error, and in which way."""

from typing import Any

from cconv.report.decidable import decidable
from cconv.report.importance_plots import importance_chart, partial_dependence_chart
from cconv.report.sections.section import Records, Section
from cconv.report.tables import importance_table
from cconv.study.records.summary import Summary


class ImportanceSection(Section):
    """Show the importance of the hyperparameters by rung, and the error against the strongest of them."""

    name = "importance"
    title = "Importance of the hyperparameters"
    part = "importance"

    def draw(self, summary: Summary, records: Records) -> dict[str, Any]:
        """Return what the trials can detect in sentences, and the charts if there is any importance."""
        importance, dependences = summary.importance, summary.partial_dependence
        is_known = any(entry.parameters for entry in importance)
        return {
            "decidable": decidable(importance),
            "shares": importance_chart(importance) if is_known else None,
            "rows": importance_table(importance).to_dict("records"),
            "dependences": partial_dependence_chart(dependences) if dependences else None,
        }
