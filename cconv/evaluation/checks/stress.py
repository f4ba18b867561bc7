"""Check of the errors on perturbed frames: denser, faster, clumped, rotated or moved compared with the data."""

from cconv.evaluation.checks.check import Check, Finding, worst_of_each_label
from cconv.evaluation.checks.material import SCALED, Material, relative_error
from cconv.evaluation.checks.predictor import Predictor


class StressedStates(Check[Material, Predictor]):
    """Mean squared error in each perturbed state ÷ its scale, of the worst of the perturbed frames."""

    name = "stress"
    sentence = (
        f"Mean squared error on perturbed frames, {SCALED}. In the states with clumped, squeezed or isolated "
        "particles, only these particles count."
    )
    failure = "error {value:.3g} on the frame {label} (limit {limit:g}); {detail}"
    limit = 0.1

    def findings(self, predictor: Predictor) -> list[Finding]:
        """Return a finding for each state."""
        return worst_of_each_label(
            self._finding(probe.name, relative_error(predictor, probe), probe.origin)
            for probe in self.material.stressed
        )
