"""Check of the rounding errors: predictions in the precision of a model compared with float64."""

import math
from typing import ClassVar

from cconv.devices import BFLOAT16, FLOAT32, TF32
from cconv.evaluation.checks.check import Check, Finding, worst_of_each_label
from cconv.evaluation.checks.material import Material, Probe
from cconv.evaluation.checks.predictor import Predictor
from cconv.evaluation.checks.states import AS_IT_IS, FAR_AWAY


class Precision(Check[Material, Predictor]):
    """Largest difference between predictions in a model's precision and float64 ÷ standard deviation of the target."""

    name = "precision"
    sentence = (
        "Largest difference between predictions in the precision of the model, single unless its study asks for TF32 "
        "or bfloat16, and in double precision, on unchanged frames and on frames moved by a thousand particle "
        "spacings, divided by the standard deviation of the target."
    )
    failure = "{label}: predictions are {value:.3g} from float64 (limit {limit:g}); {detail}"
    limit = 1e-3
    limits: ClassVar = {FLOAT32: limit, TF32: 1e-2, BFLOAT16: 1e-1}  # units of rounding are 6e-8, 5e-4 and 4e-3

    def findings(self, predictor: Predictor) -> list[Finding]:
        """Return one finding, for the state and frame with the largest difference."""
        return worst_of_each_label(
            self._finding(
                "rounding",
                self._difference(predictor, probe),
                f"{predictor.precision}, {probe.name}, {probe.origin}",
                self.limits[predictor.precision],
            )
            for probe in self.material.stressed
            if probe.name in (AS_IT_IS, FAR_AWAY)
        )

    def _difference(self, predictor: Predictor, probe: Probe) -> float:
        exact = predictor.predict_exactly(probe.frame, probe.scene).double()
        difference = (predictor.predict(probe.frame, probe.scene).double() - exact).abs().max()
        return float(difference / math.sqrt(self.material.typical))
