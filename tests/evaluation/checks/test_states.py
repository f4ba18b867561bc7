"""States of frames: those particles count that were changed."""

import pytest
from evaluation.checks.flows import flow_material

pytestmark = pytest.mark.integration


def test_particles_that_were_changed_are_those_that_count():
    material = flow_material("density_rate", dim=2, walls=False, periodic=True)
    counted = {probe.name: float(probe.affected.double().mean()) for probe in material.stressed}
    plain = material.plain[0].frame.positions
    clumped = next(probe for probe in material.stressed if probe.name == "clumped")
    moved = (clumped.frame.positions != plain).any(dim=1)
    assert 4 <= moved.sum() <= 8
    assert bool(clumped.affected[moved].all())
    assert int(clumped.affected.sum()) == 2 * int(moved.sum())
    assert counted["as_it_is"] == counted["turned"] == 1
    assert 0 < counted["squeezed"] < 1
