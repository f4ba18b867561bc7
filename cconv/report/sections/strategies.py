"""The section on stopping rules replayed on trials that were all trained to the full budget."""

from cconv.report.sections.section import Section


class StrategiesSection(Section):
    """Show what each stopping rule would have spent, and how much larger its error would have been."""

    name = "strategies"
    title = "Stopping rules replayed"
    part = "strategies"
