"""How the search space was narrowed."""

from cconv.report.sections.section import Section


class RefinedSection(Section):
    """What a narrowed space draws each hyperparameter from, and why."""

    name = "refined"
    title = "How the space was narrowed"
    part = "refined"
