"""Check that rollouts reach their last frame."""

from cconv.evaluation.checks.check import Check, Finding
from cconv.evaluation.checks.rolled import LONGER, RolloutMaterial
from cconv.rollout.rollout import StepModel


class Completion(Check[RolloutMaterial, StepModel]):
    """Share of the frames of rollouts that were not reached, because the rollout diverged."""

    name = "completion"
    sentence = (
        "Share of the frames that a rollout did not reach, because positions were not finite, a particle leapt, or "
        "particles clumped: over as many frames as are stored, and twice as many."
    )
    failure = "{value:.3g} of the frames not reached in a rollout {label} ({detail})"
    limit = 0.0

    def findings(self, predictor: StepModel) -> list[Finding]:
        """Return a finding for each length of the rollout, the worst over all starts."""
        rolled = self.material.rolled(predictor)
        worst = max(rolled, key=lambda each: each.ended is not None)
        found = []
        for times, label in ((1, "as long as stored"), (LONGER, "twice as long")):
            missed = [max(0.0, 1 - (len(each.positions) - 1) / (times * len(each.start.future))) for each in rolled]
            found.append(self._finding(label, max(missed), worst.ended or ""))
        return found
