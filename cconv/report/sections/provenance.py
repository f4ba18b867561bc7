"""Where the study comes from: commit, data, seeds, versions."""

from cconv.report.sections.section import LastingSection


class ProvenanceSection(LastingSection):
    """Commit, data, seeds and versions of the study."""

    name = "provenance"
    title = "Provenance"
