"""The provenance of a study: commit, data, seeds, versions."""

from cconv.report.sections.section import LastingSection


class ProvenanceSection(LastingSection):
    """Show commit, data, seeds and versions of the study."""

    name = "provenance"
    title = "Provenance"
