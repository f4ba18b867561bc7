"""How sure the choice is: every finalist beside the best, and what other seeds and units would give."""

from typing import Any

from cconv.report.sections.section import Records, Section
from cconv.study.records.summary import Summary


class SureSection(Section):
    """The comparison that the choice rests on, the front as one number, and what intervals cover."""

    name = "sure"
    title = "How sure are we?"
    part = "selection"

    def draw(self, summary: Summary, records: Records) -> dict[str, Any]:
        """Numbers of seeds and test units."""
        tests = [entry.test for entry in summary.finalists]
        return {"seeds": max(len(test.by_seed) for test in tests), "units": tests[0].units.count}
