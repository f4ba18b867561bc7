"""Check that the same flow scaled, turned or mirrored has the same rollout."""

from cconv.evaluation.checks.check import Finding
from cconv.evaluation.checks.compared_starts import StartCheck
from cconv.rollout.rollout import StepModel


class MappedStarts(StartCheck):
    """Distance between the rollout of a mapped flow and the mapped rollout."""

    name = "mapped_starts"
    sentence = (
        "Distance between two rollouts of one flow, of which the first is scaled by 1.5, turned by a quarter or "
        "mirrored, with walls, box and force, before the rollout and the second after it, as a share of the way that "
        "the stored fluid goes (at least a spacing). A rotation-equivariant network keeps both alike to rounding; one "
        "that is not must be as accurate in every direction."
    )
    failure = "the rollout of the flow {label} is {value:.3g} of the fluid's way off (limit {limit:.3g}; {detail})"
    limit = 0.1

    def findings(self, predictor: StepModel) -> list[Finding]:
        """Return the distance for each map."""
        plain = self.material.rolled(predictor)[0].positions
        return [
            self.distance(start.name, start, predictor, start.mapping(plain))
            for start in self.starts(("scaled", "mirrored", "turned"))
        ]
