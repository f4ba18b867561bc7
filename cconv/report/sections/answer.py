"""The answer: the recommended model, what it does, and the baseline and the analytic field beside it."""

from typing import Any

from cconv.report.sections.section import Records, Section
from cconv.study.records.summary import FinalistEntry, Summary


class AnswerSection(Section):
    """The recommended model, the reason, and its figures."""

    name = "answer"
    title = "Answer"
    part = "recommended"

    def draw(self, summary: Summary, records: Records) -> dict[str, Any]:
        """The reason in two parts, the recommended model, and the baseline as ratios if it is another model."""
        baseline = summary.finalist(summary.baseline)
        is_other = baseline is not None and baseline is not summary.chosen
        return {
            "reason": _lead(summary.recommended.reason),
            "baseline": baseline if is_other else None,
            "ratios": _ratios(baseline, summary.chosen) if is_other else {},
        }


def _lead(text: str) -> tuple[str, str]:
    """The first sentence and the others."""
    first, stop, others = text.partition(". ")
    return first + stop.strip(), others


def _ratios(baseline: FinalistEntry, chosen: FinalistEntry) -> dict[str, float]:
    return {
        "error": baseline.test.error / chosen.test.error,
        "time": baseline.cost.ms_per_frame / chosen.cost.ms_per_frame,
        "size": baseline.num_parameters / chosen.num_parameters,
    }
