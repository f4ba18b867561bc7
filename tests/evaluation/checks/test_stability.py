"""A model is stable only if all its seeds keep every limit; what is told of it is that of the worst seed."""

import json
import math

import pytest
import torch
from evaluation.checks.flows import flow, flow_material
from evaluation.checks.planted_faults import FAULTS, spoiled
from systems import configured, model_of

from cconv.evaluation.checks import make_checks
from cconv.evaluation.checks.check import NOT_FINITE
from cconv.evaluation.checks.predictor import ModelPredictor
from cconv.evaluation.checks.stability import measure_stability
from cconv.tasks.samples import make_sample

pytestmark = pytest.mark.integration

ALONE = FAULTS["no number for isolated particles"].spoil


def truth(field, *others):
    return field


def measured(material, **faults):
    """Stability of analytic SPH with a fault in each seed."""
    seeds = {name: spoiled(material, fault) for name, fault in faults.items()}
    return measure_stability(seeds, make_checks(material), material.counts)


@pytest.fixture(scope="module")
def material():
    return flow_material("density_rate", dim=2, walls=False, periodic=True)


def test_a_planted_fault_is_one_of_few_findings(material):
    """Faults in one situation leave the others alone, so that the name says where to look."""
    for name in ("zero for pairs closer than 0.2 spacings", "explosion beyond 20 times the largest speed"):
        (line,) = measured(material, it=FAULTS[name].spoil)["failures"]
        assert FAULTS[name].label in line
        assert "trajectory flow, frame" in line


def test_a_model_is_stable_only_if_all_its_seeds_are(material):
    found = measured(material, seed_1=truth, seed_2=ALONE, seed_3=truth)
    assert not found["stable"]
    assert all("seeds seed_2 of 3" in line for line in found["failures"])
    assert any("isolated" in line for line in found["failures"])
    assert next(each for each in found["findings"] if each["label"] == "isolated")["value"] == NOT_FINITE
    assert found["counts"] == {"seeds": 3, "plain_frames": 7, "stressed_frames": 3}
    assert measured(material, seed_1=truth, seed_3=truth)["stable"]


def test_the_findings_of_several_seeds_are_the_worst_of_each_check_and_label(material):
    faults = {"seed_1": FAULTS["a bias that drifts"].spoil, "seed_2": ALONE}
    together = measured(material, **faults)["findings"]
    alone = [measured(material, **{name: fault})["findings"] for name, fault in faults.items()]
    for both, first, second in zip(together, *alone, strict=True):
        assert both == (first if first["value"] >= second["value"] else second)


def test_files_can_hold_what_is_no_number(material):
    found = measured(material, it=lambda field, *others: math.nan * field)
    assert {finding["value"] for finding in found["findings"]} == {NOT_FINITE}
    assert len(found["failures"]) == len(found["findings"])
    json.dumps(found, allow_nan=False)


def test_an_untrained_model_is_not_stable():
    trajectory, scene = flow(2, walls=True, periodic=False)
    material = flow_material("density_rate", dim=2, walls=True, periodic=False)
    samples = [make_sample(frame, scene, material.task) for frame in trajectory]
    network = configured(layers=2, first_channels=4, hidden_channels=4)
    model = model_of(network, scene, "density_rate", samples, torch.Generator().manual_seed(0))
    found = measure_stability({"it": ModelPredictor(model)}, make_checks(material), material.counts)
    assert not found["stable"]
    assert any("regime bulk" in line for line in found["failures"])
    assert any("frame as_it_is" in line for line in found["failures"])
    json.dumps(found, allow_nan=False)
