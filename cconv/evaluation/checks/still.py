"""Check of predicted rates of density where no density changes: at rest and in uniform motion."""

from dataclasses import replace

import torch

from cconv.data.trajectory import Frame, Scene
from cconv.evaluation.checks.check import Check, Finding, worst_of_each_label
from cconv.evaluation.checks.material import Material, relative_error
from cconv.evaluation.checks.predictor import Predictor
from cconv.evaluation.checks.states import State, oblique


class StillStates(Check[Material, Predictor]):
    """Mean square of a rate that should be 0 ÷ a tenth of the target's variance."""

    name = "still"
    sentence = (
        "Mean squared rate at rest and in uniform motion at ten times the largest speed, where the true rate is 0, "
        "divided by a tenth of the target's variance."
    )
    failure = "rate {value:.3g} where nothing changes, {label} (limit {limit:g}); {detail}"
    limit = 0.1

    def __init__(self, material: Material):
        super().__init__(material)
        self._probes = [
            material.answered(state, origin)
            for frame, origin in material.few
            for state in still_states(frame, material.scene, material.fastest)
        ]

    def findings(self, predictor: Predictor) -> list[Finding]:
        """Return a finding for each state."""
        return worst_of_each_label(
            self._finding(probe.name, relative_error(predictor, probe), probe.origin) for probe in self._probes
        )


def still_states(frame: Frame, scene: Scene, fastest: float) -> list[State]:
    """Return the frame at rest, and in uniform motion at ten times the speed `fastest`; its density is constant."""
    at_rest = torch.zeros_like(frame.velocities)
    moving = at_rest + 10 * fastest * oblique(scene.dim).to(at_rest.dtype)
    return [
        State(name="rest", frame=replace(frame, velocities=at_rest), scene=scene),
        State(name="uniform_velocity", frame=replace(frame, velocities=moving), scene=scene),
    ]
