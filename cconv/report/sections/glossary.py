"""The glossary of the report."""

from cconv.report.sections.section import LastingSection


class GlossarySection(LastingSection):
    """Explain the technical words of the report."""

    name = "glossary"
    title = "Glossary"
