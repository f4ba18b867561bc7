"""Errors by regime add up to the whole error."""

import pytest
import torch
from evaluation.checks.flows import flow_material
from evaluation.checks.planted_faults import spoiled

from cconv.evaluation.checks.material import squared_errors
from cconv.evaluation.checks.regimes import Regimes

pytestmark = pytest.mark.integration


def test_regimes_share_out_all_particles_and_their_errors():
    material = flow_material("density_rate", dim=2, walls=True, periodic=False)
    predictor = spoiled(material, lambda field, state, *others: 0.9 * field + state.positions[:, :1])
    check = Regimes(material)
    errors = {finding.label: finding.value for finding in check.findings(predictor)}
    whole = torch.cat([squared_errors(predictor, probe) for probe in material.plain])
    regimes = {regime.name: regime for regime in check.regimes}
    for names in (
        {"near_wall", "free_surface", "bulk"},
        {name for name in regimes if name.startswith("neighbors")},
        {name for name in regimes if name.startswith("speed")},
    ):
        present = [regimes[name] for name in names & set(regimes)]
        assert sum(regime.share for regime in present) == pytest.approx(1.0)
        mean = sum(regime.share * errors[regime.name] * regime.scale for regime in present)
        assert mean == pytest.approx(float(whole.mean()))
