"""The luck of initial weights."""

from cconv.report.sections.section import Section


class SeedVarianceSection(Section):
    """Spread of the error over initial weights beside that over configurations."""

    name = "seed_variance"
    title = "The luck of initial weights"
    part = "initialization"
