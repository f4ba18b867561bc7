"""The words of the report."""

from cconv.report.sections.section import LastingSection


class GlossarySection(LastingSection):
    """What the words of the report mean."""

    name = "glossary"
    title = "Glossary"
