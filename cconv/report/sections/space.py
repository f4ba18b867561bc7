"""The section on the search space."""

from cconv.report.sections.section import LastingSection


class SpaceSection(LastingSection):
    """Show the hyperparameters of the search space with their domains and reasons."""

    name = "space"
    title = "Search space"
