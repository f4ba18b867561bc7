"""Check of the motion in rollouts: kinetic energy, momentum and the largest displacement."""

import torch
from torch import Tensor

from cconv.data.window import Window
from cconv.evaluation.checks.rolled import Bound, SeriesCheck
from cconv.evaluation.rollout_metrics import kinetic_energies, momentum_drift

CALM = 0.01  # share of the largest stored energy below which energies count as equal


class Motion(SeriesCheck):
    """Energy against the stored one, drift of the momentum where nothing can change it, largest displacement."""

    name = "motion"
    sentence = (
        "Kinetic energy of a rollout divided by that of the stored frame (after the last one, by the largest of the "
        "second half), and the inverse, energies below a hundredth of the largest counted as that; drift of the "
        "momentum relative to the sum of the initial magnitudes, where there are no walls and no force; largest "
        "displacement in a frame, in particle spacings."
    )
    failure = "{label} {value:.3g} (limit {limit:.3g}; {detail})"
    bounds = {
        "energy too high": Bound(2.0, 1.0),
        "energy too low": Bound(2.0, 1.0),
        "momentum drift": Bound(0.02, 2.0),
        "largest displacement": Bound(0.0, 2.0),
    }

    def series(self, positions: Tensor, start: Window) -> dict[str, Tensor]:
        """Quantities of each frame; see `SeriesCheck.series`."""
        scene, fluid = self.material.scene, start.is_fluid
        moving, stored = positions[:, fluid], self._stored(start)[:, fluid]
        before = start.positions[-2][None, fluid].double()
        energies = [
            kinetic_energies(torch.cat([before, each]), scene.box, scene.particle_spacing, scene.frame_dt)
            for each in (moving, stored)
        ]
        found, expected = (each.clamp(min=CALM * float(energies[1].max())) for each in energies)
        compared = min(len(found), len(expected))
        later = expected[len(expected) // 2 :].max().expand(len(found) - compared)
        steps = scene.box.displacement(moving, torch.cat([before, moving[:-1]])).norm(dim=2).amax(dim=1)
        series = {
            "energy too high": found / torch.cat([expected[:compared], later]),
            "energy too low": expected[:compared] / found[:compared],
            "largest displacement": steps / scene.particle_spacing,
        }
        if all(scene.box.periodic) and scene.force is None and bool(fluid.all()) and start.boundary is None:
            path = torch.cat([before, moving])
            series["momentum drift"] = momentum_drift(path, start.masses[fluid], scene.box)
        return series
