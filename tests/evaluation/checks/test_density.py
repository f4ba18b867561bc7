"""The density that follows from a predicted rate: exact for the exact rate, however far frames lie apart."""

from dataclasses import replace

import pytest
import torch
from evaluation.checks.flows import flow_material
from evaluation.checks.planted_faults import FAULTS, Analytic, spoiled

from cconv.evaluation.checks import density
from cconv.evaluation.checks.density import IntegratedDensity

pytestmark = pytest.mark.integration


@pytest.fixture
def material():
    return flow_material("density_rate", dim=2, walls=False, periodic=True)


def test_the_integral_of_the_analytic_rate_does_not_drift(material):
    kernel = material.task.kernel_at(material.scene.particle_spacing, material.scene.dim)
    check = IntegratedDensity(material)
    exact = Analytic(task="density_rate", kernel=kernel, dtype=torch.float64)
    assert check.deviations(exact).tolist() == [0.0] * 7
    assert [finding.detail for finding in check.findings(exact)] == ["over 7 frames"]


def test_frames_that_lie_apart_spoil_the_integral_of_the_rate_but_not_the_check(material):
    """The same flow in steps of one frame and of six: a bias drifts alike, though the rate alone is far off."""
    trajectory = material.trajectory
    every_sixth = replace(trajectory, positions=trajectory.positions[::6], velocities=trajectory.velocities[::6])
    scene = replace(material.scene, frame_dt=6 * material.scene.frame_dt)
    fine, coarse = (
        IntegratedDensity(material),
        IntegratedDensity(replace(material, trajectory=every_sixth, scene=scene)),
    )
    biased = spoiled(material, FAULTS["a bias that drifts"].spoil)
    assert float(coarse.deviations(biased)[-1]) == pytest.approx(float(fine.deviations(biased)[-1]), rel=1e-3)
    assert coarse.analytic_deviation() > 0.05  # by which the rate alone, summed over frames, misses the density
    assert f"{100 * coarse.analytic_deviation():.3g} %" in coarse.description()


def test_the_first_frame_beyond_the_limit_is_told(material):
    nothing = spoiled(material, lambda field, *others: torch.nan * field)
    assert [finding.detail for finding in IntegratedDensity(material).findings(nothing)] == ["first at frame 1 of 7"]


def test_the_number_of_frames_is_bounded(material):
    trajectory = material.trajectory
    long = replace(
        trajectory, positions=trajectory.positions.repeat(5, 1, 1), velocities=trajectory.velocities.repeat(5, 1, 1)
    )
    check = IntegratedDensity(replace(material, trajectory=long))
    assert len(check.deviations(spoiled(material, lambda field, *others: field))) == density.FRAMES
