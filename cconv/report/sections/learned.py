"""The section on what the recommended model and the baseline learned: filters, a predicted frame, particle errors."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from cconv.report.fields import error_distribution_chart, fields_chart, filters_chart, read_explanations
from cconv.report.sections.section import Records, Section
from cconv.study.records.summary import Summary


class LearnedSection(Section):
    """Show filters beside those of analytic SPH, a predicted beside the true field, and the spread of the errors."""

    name = "learned"
    title = "What the models learned"
    part = "explained"

    def draw(self, summary: Summary, records: Records) -> dict[str, Any]:
        """Draw the charts of each explained model, the recommended one first."""
        explanations = read_explanations(records.run, summary.explained)
        best = summary.recommended.id
        names = sorted(explanations, key=lambda name: name != best)
        return {
            "distribution": error_distribution_chart(explanations, summary.baseline, best),
            "models": {
                name: {
                    "fields": fields_chart(explanations[name], summary.task.symbol),
                    "filters": _filters(explanations[name]),
                }
                for name in names
            },
        }


def _filters(explanation: Mapping[str, np.ndarray]) -> dict[str, Any] | None:
    """Chart the filters and say how close they come; None for a network without filters."""
    if "unexplained" not in explanation:
        return None
    return {
        "chart": filters_chart(explanation),
        "unexplained": float(explanation["unexplained"]),
        "is_combined": bool(explanation["is_combined"]),
    }
