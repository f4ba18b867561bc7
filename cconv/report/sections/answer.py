"""The answer: the recommended model and its figures, compared with the baseline and the analytic field."""

from typing import Any

from cconv.report.sections.section import Records, Section
from cconv.study.records.summary import FinalistEntry, Summary


class AnswerSection(Section):
    """Show the recommended model, the reason, and its figures."""

    name = "answer"
    title = "Answer"
    part = "recommended"

    def draw(self, summary: Summary, records: Records) -> dict[str, Any]:
        """Return the reason in two parts, and the baseline as ratios to the recommended model if they differ."""
        baseline = summary.finalist(summary.baseline)
        other = None if baseline is summary.chosen else baseline
        return {
            "reason": _lead(summary.recommended.reason),
            "baseline": other,
            "ratios": {} if other is None else _ratios(other, summary.chosen),
        }


def _lead(text: str) -> tuple[str, str]:
    """Split a text into its first sentence and the others."""
    first, stop, others = text.partition(". ")
    return first + stop.strip(), others


def _ratios(baseline: FinalistEntry, chosen: FinalistEntry) -> dict[str, float | None]:
    """Divide error, time and size of the baseline by those of the recommended model; no ratio to an error of 0."""
    return {
        "error": baseline.test.error / chosen.test.error if chosen.test.error else None,
        "time": baseline.cost.ms_per_frame / chosen.cost.ms_per_frame,
        "size": baseline.num_parameters / chosen.num_parameters,
    }
