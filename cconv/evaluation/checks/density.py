"""Check of the density that follows from integrating a predicted rate over time."""

import math

import torch
from torch import Tensor

from cconv.evaluation.checks.check import Check, Finding
from cconv.evaluation.checks.material import Material
from cconv.evaluation.checks.predictor import Predictor

FRAMES = 30  # of a trajectory that the rate is integrated over
USUAL = 0.95  # share of the particles whose density must keep the limit


class IntegratedDensity(Check[Material, Predictor]):
    r"""Relative deviation of the density that follows from integrating a predicted rate over stored frames.

    The analytic rate is exactly the derivative of the summed density (`cconv.sph.density_rate`), so that integrated
    without error it leads back to it, and the predicted rate to

    .. math:: \rho_i(t) + \int_0^t (\dot\rho^\text{model}_i - \dot\rho_i)\, dt'

    Only that integral is taken from stored frames, by the trapezoidal rule: what the rule misses of the rate itself,
    since frames may lie far apart, is common to both rates and cancels.

    Source: the limit is that of Neural SPH (Toshev et al. 2024).
    """

    name = "density"
    sentence = (
        "Relative error of the density if the predicted rate is integrated over consecutive frames in place of the "
        "analytic one: the 95th percentile of the particles, and of that the largest over the frames."
    )
    failure = "{label} deviates by {value:.3g} (limit {limit:g}); {detail}"
    limit = 0.02

    def __init__(self, material: Material):
        super().__init__(material)
        trajectory = material.trajectory
        self._frames = [trajectory[index] for index in range(min(len(trajectory), FRAMES))]
        states = [material.task.state(frame, material.scene) for frame in self._frames]
        self._rates = torch.stack([material.task.field(state)[:, 0] for state in states])
        self._densities = torch.stack([state.densities for state in states])

    def findings(self, predictor: Predictor) -> list[Finding]:
        """Return one finding, with the first frame whose deviation is beyond the limit."""
        usual = self.deviations(predictor)
        outside = (~(usual <= self.limit)).nonzero()[:, 0].tolist()
        detail = f"first at frame {outside[0]} of {len(usual)}" if outside else f"over {len(usual)} frames"
        return [self._finding("integrated density", usual.max(), detail)]

    def description(self) -> str:
        """Return the sentence, and the deviation of the analytic rate, which is integrated from stored frames too."""
        return (
            f"{self.sentence} The analytic rate, integrated in the same way, would have an error of "
            f"{100 * self.analytic_deviation():.3g} %, because stored frames lie far apart; it is not counted."
        )

    def deviations(self, predictor: Predictor) -> Tensor:
        """95th percentile over particles of the relative deviation at each frame (T,), float64; infinity for NaN."""
        predicted = torch.stack(
            [predictor.predict(frame, self.material.scene)[:, 0].double() for frame in self._frames]
        )
        return self._usual(self._integrated(predicted - self._rates) / self._densities)

    def analytic_deviation(self) -> float:
        """Largest deviation over frames if the analytic rate itself is integrated from the first density."""
        alone = (self._densities[0] + self._integrated(self._rates)) / self._densities - 1
        return float(self._usual(alone).max())

    def _usual(self, deviations: Tensor) -> Tensor:
        return deviations.abs().nan_to_num(nan=math.inf, posinf=math.inf).quantile(USUAL, dim=1)

    def _integrated(self, rates: Tensor) -> Tensor:
        """Integral (T, N) of rates (T, N) from the first frame to each, by the trapezoidal rule."""
        steps = self.material.scene.frame_dt * (rates[1:] + rates[:-1]) / 2
        return torch.cat([torch.zeros_like(rates[:1]), steps.cumsum(dim=0)])
