"""The section on the narrowed search space."""

from cconv.report.sections.section import Section


class RefinedSection(Section):
    """Show the domain of each hyperparameter in the narrowed space, and the evidence for it."""

    name = "refined"
    title = "How the space was narrowed"
    part = "refined"
