"""The section on the seed variance."""

from cconv.report.sections.section import Section


class SeedVarianceSection(Section):
    """Show the spread of the error over initial weights beside the spread over configurations."""

    name = "seed_variance"
    title = "Seed variance"
    part = "initialization"
