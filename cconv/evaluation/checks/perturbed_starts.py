"""Check of rollouts that begin with shaken or squeezed fluid."""

import math

from cconv.evaluation.checks.check import Finding
from cconv.evaluation.checks.compared_starts import StartCheck
from cconv.evaluation.checks.starts import Start
from cconv.evaluation.rollout_metrics import kinetic_energies
from cconv.rollout.rollout import StepModel

MOST_ENERGY = 2.0  # times that of the plain rollout


class PerturbedStarts(StartCheck):
    """How far disorder takes a rollout from the one without it, and how much energy it adds."""

    name = "perturbed_starts"
    sentence = (
        "Distance between two rollouts, one from stored frames and one from the same frames with every particle "
        "shifted at random by a twentieth of a spacing, or with fluid within four spacings squeezed by up to a tenth, "
        "as a share of the way that the stored fluid goes (at least a spacing); and the largest kinetic energy of the "
        "second rollout divided by that of the first. The solver itself, restarted from such frames, stays below a "
        "fifth and below 1.5."
    )
    failure = "{label} {value:.3g} (limit {limit:.3g}; {detail})"
    limit = 0.5

    def findings(self, predictor: StepModel) -> list[Finding]:
        """Return the distance and the energy for each kind of disorder."""
        return [
            finding
            for start in self.starts(("shaken", "squeezed"))
            for finding in (self._apart(start, predictor), self._energy(start, predictor))
        ]

    def _apart(self, start: Start, predictor: StepModel) -> Finding:
        plain = self.material.rolled(predictor)[0]
        return self.distance(f"distance once {start.name}", start, predictor, plain.positions)

    def _energy(self, start: Start, predictor: StepModel) -> Finding:
        label = f"energy once {start.name}"
        plain, rolled = self.material.rolled(predictor)[0], self.material.rolled_from(predictor, start)
        frames = min(len(plain.positions), 1 + len(start.window.future))
        if min(frames, len(rolled.positions)) < 2:
            return self._finding(label, math.inf, rolled.ended or plain.ended or "", MOST_ENERGY)
        scene, fluid = self.material.scene, start.window.is_fluid
        expected, found = (
            kinetic_energies(each.positions[:frames, fluid], scene.box, scene.particle_spacing, scene.frame_dt)
            for each in (plain, rolled)
        )
        detail = f"largest at frame {1 + int(found.argmax())} after the start"
        return self._finding(label, float(found.max() / expected.max()), detail, MOST_ENERGY)
