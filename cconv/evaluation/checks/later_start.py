"""Check of a rollout that begins late in a trajectory."""

from cconv.evaluation.checks.check import Finding
from cconv.evaluation.checks.compared_starts import StartCheck, stored
from cconv.rollout.rollout import StepModel


class LaterStart(StartCheck):
    """Distance between stored frames at the end of a trajectory and the rollout that begins before them."""

    name = "later_start"
    sentence = (
        "Distance between the last stored frames of a trajectory and a rollout that begins right before them, as a "
        "share of the way that the stored fluid goes (at least a spacing): 1 is as wrong as fluid that stands still. "
        "The solver itself, restarted where water hits a wall, reaches an eighth."
    )
    failure = "a rollout that begins {label} is {value:.3g} of the fluid's way off (limit {limit:.3g}; {detail})"
    limit = 0.5

    def findings(self, predictor: StepModel) -> list[Finding]:
        """Return the distance."""
        return [self.distance(start.name, start, predictor, stored(start)) for start in self.starts(("later",))]
