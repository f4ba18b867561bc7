"""Errors where methods fail: in states that are denser, faster, clumped, turned or moved, compared with the data."""

from cconv.evaluation.checks.check import Check, Finding, worst_of_each_label
from cconv.evaluation.checks.material import SCALED, relative_error
from cconv.evaluation.checks.predictor import Predictor


class StressedStates(Check):
    """Mean squared error in each stressed state by its scale, in the worst of the frames that were put into it."""

    name = "stress"
    sentence = (
        f"Mean squared error on frames in other states, {SCALED}. Of clumped, squeezed and isolated particles only "
        "these count."
    )
    failure = "error {value:.3g} on the frame {label} (limit {limit:g}); {detail}"
    limit = 0.1

    def findings(self, predictor: Predictor) -> list[Finding]:
        """A finding for each state."""
        return worst_of_each_label(
            self._finding(probe.name, relative_error(predictor, probe), probe.origin)
            for probe in self.material.stressed
        )
