"""The section on the certainty of the choice: every finalist compared with the best, over seeds and units."""

from typing import Any

from cconv.report.sections.section import Records, Section
from cconv.study.records.summary import Summary


class SureSection(Section):
    """Show the comparison behind the choice, the hypervolume of the front, and how the intervals are meant."""

    name = "sure"
    title = "How certain is the choice?"
    part = "selection"

    def draw(self, summary: Summary, records: Records) -> dict[str, Any]:
        """Return the numbers of seeds and test units."""
        tests = [entry.test for entry in summary.finalists]
        return {"seeds": max(len(test.by_seed) for test in tests), "units": tests[0].units.count}
