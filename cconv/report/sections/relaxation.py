"""The section on SPH relaxation: how much better rollouts become with it, and which setting was chosen."""

from typing import Any

from cconv.report.relaxation_plots import relaxations_chart, relaxations_table
from cconv.report.sections.section import Records, Section
from cconv.study.records.summary import Summary


class RelaxationSection(Section):
    """Show quality against loops of the relaxations that were tried, their front and the choice."""

    name = "relaxation"
    title = "SPH relaxation"
    part = "relaxed"

    def draw(self, summary: Summary, records: Records) -> dict[str, Any]:
        """Draw the relaxations that were tried, and list the front of each model."""
        relaxed = summary.relaxed
        if relaxed is None:
            return {}
        rows = {name: relaxations_table(model, relaxed.chosen[name]) for name, model in relaxed.models.items()}
        own = relaxed.models[summary.recommended.id].tried[relaxed.chosen[summary.recommended.id]]
        failed = {name: [each for each in model.tried if each.diverged] for name, model in relaxed.models.items()}
        return {"chart": relaxations_chart(relaxed), "rows": rows, "own": own, "failed": failed}
