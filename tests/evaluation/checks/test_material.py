"""What checks are made of: bounded numbers of frames, answered once, scaled by what is usual."""

from collections import Counter
from dataclasses import replace

import pytest
import torch
from evaluation.checks.flows import flow, flow_material
from evaluation.checks.planted_faults import spoiled

from cconv.errors import DataError
from cconv.evaluation.checks import make_checks
from cconv.evaluation.checks.material import PLAIN_FRAMES, STRESSED_FRAMES, make_material, relative_error
from cconv.evaluation.checks.stability import measure_stability
from cconv.tasks import task_named
from cconv.tasks.density_rate import DensityRate

pytestmark = pytest.mark.integration


def test_the_number_of_frames_is_bounded():
    trajectory, scene = flow(2, walls=False, periodic=True, frames=3)
    long = replace(
        trajectory,
        positions=trajectory.positions.repeat(20, 1, 1),
        velocities=trajectory.velocities.repeat(20, 1, 1),
    )
    material = make_material([long, replace(long, name="other")], scene, task_named("density_rate"))
    assert len(material.plain) == PLAIN_FRAMES
    assert len(material.few) == STRESSED_FRAMES
    assert len({probe.origin for probe in material.stressed}) == STRESSED_FRAMES


def test_only_frames_that_are_looked_at_are_read():
    trajectory, scene = flow(2, walls=False, periodic=True, frames=3)
    read = set()

    class Stored:
        name, first_frame, particle_types, boundary = "stored", 0, trajectory.particle_types, trajectory.boundary

        def __len__(self):
            return 1000

        def __getitem__(self, index):
            read.add(index)
            return trajectory[index % 3]

    material = make_material([Stored()], scene, task_named("density_rate"))
    assert len(material.plain) == PLAIN_FRAMES
    assert len(read) <= PLAIN_FRAMES + STRESSED_FRAMES


def test_frames_from_start_to_end_are_stressed():
    material = flow_material("density_rate", dim=2, walls=False, periodic=True)
    origins = list(dict.fromkeys(probe.origin for probe in material.stressed))
    assert origins == [f"trajectory flow, frame {index}" for index in (0, 3, 6)]


def test_every_frame_is_answered_once():
    trajectory, scene = flow(2, walls=False, periodic=True)
    asked = Counter()

    class Counting(DensityRate):
        def field(self, state):
            asked[tuple(state.positions[0].tolist())] += 1
            return super().field(state)

    make_material([trajectory], scene, Counting())
    assert set(asked.values()) == {1}
    assert len(asked) == len(trajectory)


def test_without_frames_there_is_nothing_to_check():
    with pytest.raises(DataError, match="at least one"):
        make_material([], flow(2, walls=False, periodic=True)[1], task_named("density_rate"))


def test_a_fault_of_few_particles_is_not_averaged_away():
    """One particle in a thousand is off by the typical rate; where it is the one that counts, nothing else does."""
    probe = flow_material("density_rate", dim=2, walls=False, periodic=True).plain[0]
    wrong = torch.zeros(1000, 1)
    wrong[7] = 1.0
    probe = replace(probe, target=torch.zeros(1000, 1).double(), affected=wrong[:, 0] > 0, scale=1.0)

    class Constant:
        def predict(self, frame, scene):
            return wrong

    assert relative_error(Constant(), probe) == 1.0
    assert relative_error(Constant(), replace(probe, affected=probe.affected | True)) == pytest.approx(1e-3)
    assert relative_error(Constant(), replace(probe, affected=probe.affected & False)) == 0.0


def test_a_trajectory_at_rest_is_judged_too():
    """Rates that are all zero leave nothing to divide by; the analytic field passes and a constant does not."""
    trajectory, scene = flow(2, walls=False, periodic=True)
    resting = replace(trajectory, velocities=torch.zeros_like(trajectory.velocities))
    material = make_material([resting], scene, task_named("density_rate"))
    checks = make_checks(material)
    faults = {"truth": lambda field, *others: field, "constant": lambda field, *others: field + 1}
    stable = {
        name: measure_stability({"it": spoiled(material, fault)}, checks, material.counts)["stable"]
        for name, fault in faults.items()
    }
    assert stable == {"truth": True, "constant": False}
