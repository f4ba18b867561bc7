"""What every check of stability must hold for every task that names it: it passes the truth and catches its faults."""

import pytest
import torch
from contracts.registered import registered
from evaluation.checks.flows import flow_material
from evaluation.checks.planted_faults import FAULTS, Analytic, spoiled

from cconv.evaluation.checks import CHECKS
from cconv.evaluation.checks.check import Check
from cconv.tasks import TASKS
from cconv.tasks.task import FieldTask

FLOWS = [{"dim": 2, "walls": walls, "periodic": periodic} for walls in (False, True) for periodic in (False, True)]
FLOWS += [{"dim": 3, "walls": walls, "periodic": not walls} for walls in (False, True)]
PAIRS = [(name, check) for name, task in TASKS.items() if issubclass(task, FieldTask) for check in task.checks]
pairs = pytest.mark.parametrize(("task", "check"), PAIRS)


def test_every_check_of_the_folder_is_in_its_list():
    assert registered("evaluation/checks", Check) == set(CHECKS.values())
    assert all(check.name == name for name, check in CHECKS.items())


def test_tasks_name_checks_that_there_are_and_every_check_is_named():
    named = [(name, check) for name, task in TASKS.items() for check in task.checks]
    assert {check for _, check in named} == set(CHECKS)
    assert len(set(named)) == len(named)


@pytest.mark.integration
@pairs
@pytest.mark.parametrize("flow", FLOWS, ids=str)
def test_analytic_sph_passes(flow, task, check):
    material = flow_material(task, **flow)
    kernel = material.task.kernel_at(material.scene.particle_spacing, material.scene.dim)
    made = CHECKS[check](material)
    for dtype in (torch.float32, torch.float64):
        findings = made.findings(Analytic(task=task, kernel=kernel, dtype=dtype))
        assert findings
        assert [finding for finding in findings if not finding.passes] == []
        assert {(finding.check, finding.limit) for finding in findings} == {(check, made.limit)}


@pytest.mark.integration
@pairs
def test_every_planted_fault_of_its_kind_is_caught_by_name(task, check):
    faults = {name: fault for name, fault in FAULTS.items() if fault.check == check and task in fault.tasks}
    assert faults, f"plant a fault in {task} that {check} catches"
    for name, fault in faults.items():
        for flow in fault.places:
            material = flow_material(task, **flow)
            findings = CHECKS[check](material).findings(spoiled(material, fault.spoil))
            caught = [finding.label for finding in findings if not finding.passes]
            assert any(fault.label in label for label in caught), (name, flow, caught)


@pytest.mark.integration
@pairs
def test_labels_are_the_same_for_all_predictors_and_each_is_there_once(task, check):
    """So that findings of several seeds can be compared."""
    material = flow_material(task, dim=2, walls=True, periodic=False)
    made = CHECKS[check](material)
    predictors = spoiled(material, lambda field, *others: field), spoiled(material, lambda field, *others: 0 * field)
    first, second = ([finding.label for finding in made.findings(each)] for each in predictors)
    assert first == second
    assert len(set(first)) == len(first)


@pytest.mark.integration
@pairs
def test_predictions_that_are_no_number_fail_and_are_told_in_one_line(task, check):
    material = flow_material(task, dim=2, walls=False, periodic=True)
    made = CHECKS[check](material)
    findings = made.findings(spoiled(material, lambda field, *others: torch.nan * field))
    assert not any(finding.passes for finding in findings)
    lines = [made.in_words(finding) for finding in findings]
    assert all(
        f"(limit {made.limit:g})" in line and finding.label in line
        for line, finding in zip(lines, findings, strict=True)
    )
    assert made.description().startswith(made.sentence)
