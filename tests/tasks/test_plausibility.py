"""Fields that are the same everywhere are named; those of a moving fluid are not."""

from dataclasses import replace

import pytest
import torch
from particle_files import write_hdf5
from systems import periodic_frame, periodic_scene

from cconv.data.dataset import open_dataset
from cconv.data.plausibility import refuse_nonsense
from cconv.errors import DataError
from cconv.tasks import field_tasks, task_named
from cconv.tasks.plausibility import field_findings, target_findings
from cconv.tasks.samples import make_sample


@pytest.mark.parametrize("stops", [True, False])
def test_the_density_of_fluid_that_moves_as_one_does_not_change(generator, stops):
    frame = periodic_frame(generator)
    as_one = replace(frame, velocities=torch.ones_like(frame.velocities))
    task = task_named("density_rate")
    samples = [make_sample(each, periodic_scene(), task, "train/00000", 4) for each in (as_one, as_one)]
    (finding,) = target_findings(samples, task, stops)
    assert str(finding).startswith("trajectory train/00000, frame 4: the target of the task 'density_rate'")
    assert finding.stops == stops
    if stops:
        with pytest.raises(DataError, match="nothing to learn"):
            refuse_nonsense([finding])


@pytest.mark.parametrize("task", field_tasks(), ids=lambda task: task.name)
def test_a_fluid_that_moves_and_is_disordered_teaches_something(generator, task):
    samples = [make_sample(periodic_frame(generator), periodic_scene(), task)]
    assert target_findings(samples, task, stops=True) == []


def test_fields_of_a_simulation_teach_something(flow_folder):
    assert field_findings(open_dataset(flow_folder), field_tasks()) == []


def test_a_field_whose_kernel_does_not_fit_the_box_is_told(tmp_path):
    write_hdf5(tmp_path, {"bounds": [[0.0, 1.0], [0.0, 1.0]], "dx": 0.4})
    findings = field_findings(open_dataset(tmp_path), [task_named("density_rate")])
    assert ["cannot be asked of these data: `cutoff` must be at most half" in str(each) for each in findings] == [True]
