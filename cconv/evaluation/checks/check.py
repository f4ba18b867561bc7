"""The base class of a check of stability, and its findings."""

import math
from abc import ABC, abstractmethod
from collections.abc import Iterable
from dataclasses import dataclass
from typing import ClassVar, Generic, TypeVar

from torch import Tensor

NOT_FINITE = 1e9  # stands for infinity and NaN, which JSON files cannot hold


@dataclass(frozen=True, kw_only=True)
class Finding:
    """A value that a check measured, with its limit.

    Attributes:
        check: Name of the check.
        label: The part of the check, e.g. a regime or a state of the frame.
        value: The measured value; `NOT_FINITE` if it is infinite or NaN.
        limit: Largest value that passes.
        detail: Further facts for a reader, such as the frame.
    """

    check: str
    label: str
    value: float
    limit: float
    detail: str = ""

    @property
    def passes(self) -> bool:
        """Whether the limit is kept."""
        return self.value <= self.limit


MaterialT = TypeVar("MaterialT")
PredictorT = TypeVar("PredictorT")


class Check(ABC, Generic[MaterialT, PredictorT]):
    """A requirement on the models of a task; its frames are prepared once for all models.

    Attributes:
        name: Name by which tasks ask for the check.
        sentence: Description of the measured value, for a reader of the report.
        failure: Template of a sentence for a finding beyond the limit, with its fields in braces.
        limit: Largest value that passes.

    Args:
        material: What models are checked on: frames with their analytic answers, or starts of rollouts.
    """

    name: ClassVar[str]
    sentence: ClassVar[str]
    failure: ClassVar[str]
    limit: ClassVar[float]

    def __init__(self, material: MaterialT):
        self.material = material

    @abstractmethod
    def findings(self, predictor: PredictorT) -> list[Finding]:
        """Measure a predictor; labels and their order are the same for all predictors."""

    def description(self) -> str:
        """Return the sentence, and further facts that do not depend on the model."""
        return self.sentence

    def in_words(self, finding: Finding) -> str:
        """Describe a finding beyond the limit in one line."""
        return self.failure.format(**vars(finding))

    def _finding(self, label: str, value: Tensor | float, detail: str = "", limit: float | None = None) -> Finding:
        finite = float(value) if math.isfinite(value) else NOT_FINITE
        largest = self.limit if limit is None else limit
        return Finding(check=self.name, label=label, value=finite, limit=largest, detail=detail)


def worst_of_each_label(findings: Iterable[Finding]) -> list[Finding]:
    """Return the finding with the largest value of each label, in the order in which the labels first appear."""
    worst: dict[str, Finding] = {}
    for finding in findings:
        if finding.label not in worst or finding.value > worst[finding.label].value:
            worst[finding.label] = finding
    return list(worst.values())
