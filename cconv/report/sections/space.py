"""What was searched."""

from cconv.report.sections.section import LastingSection


class SpaceSection(LastingSection):
    """The hyperparameters of the search space, with their domains and reasons."""

    name = "space"
    title = "What was searched"
