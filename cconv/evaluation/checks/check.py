"""A check of a model, and what it finds."""

import math
from abc import ABC, abstractmethod
from collections.abc import Iterable
from dataclasses import dataclass
from typing import ClassVar

from torch import Tensor

from cconv.evaluation.checks.material import Material
from cconv.evaluation.checks.predictor import Predictor

NOT_FINITE = 1e9  # stands for a value that is infinite or no number, so that files can hold it


@dataclass(frozen=True, kw_only=True)
class Finding:
    """What a check measured.

    Attributes:
        check: Name of the check.
        label: What was looked at, e.g. a regime or a state.
        value: What was measured; `NOT_FINITE` for what is infinite or no number.
        limit: What it must not exceed.
        detail: What else a reader needs, such as the frame.
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


class Check(ABC):
    """Something that must hold for a model of a task; what it asks is made once, for all models.

    Attributes:
        name: Name by which tasks ask for the check.
        sentence: What it looks at, for a reader of the report.
        failure: A finding beyond the limit in words, with its fields in braces.
        limit: What no value may exceed.

    Args:
        material: Frames with their analytic answers.
    """

    name: ClassVar[str]
    sentence: ClassVar[str]
    failure: ClassVar[str]
    limit: ClassVar[float]

    def __init__(self, material: Material):
        self.material = material

    @abstractmethod
    def findings(self, predictor: Predictor) -> list[Finding]:
        """What the check finds in a predictor; labels and their order are the same for all predictors."""

    def description(self) -> str:
        """The sentence, and what else the material alone says."""
        return self.sentence

    def in_words(self, finding: Finding) -> str:
        """A finding beyond the limit, in one line."""
        return self.failure.format(**vars(finding))

    def _finding(self, label: str, value: Tensor | float, detail: str = "") -> Finding:
        finite = float(value) if math.isfinite(value) else NOT_FINITE
        return Finding(check=self.name, label=label, value=finite, limit=self.limit, detail=detail)


def worst_of_each_label(findings: Iterable[Finding]) -> list[Finding]:
    """The finding with the largest value of each label, in the order in which labels come first."""
    worst: dict[str, Finding] = {}
    for finding in findings:
        if finding.label not in worst or finding.value > worst[finding.label].value:
            worst[finding.label] = finding
    return list(worst.values())
