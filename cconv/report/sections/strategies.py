"""Search strategies replayed on trials that nothing stopped."""

from cconv.report.sections.section import Section


class StrategiesSection(Section):
    """What each strategy would have spent and lost."""

    name = "strategies"
    title = "Strategies replayed"
    part = "strategies"
