"""The solver in the place of a model: its rollouts are its own frames, and they pass every check, disturbed or not."""

from dataclasses import replace
from itertools import islice

import pytest
import torch

from cconv.data.dataset import open_dataset
from cconv.data.generate import generate
from cconv.data.restart import solved_frames
from cconv.data.window import window_at
from cconv.evaluation.checks import CHECKS
from cconv.evaluation.checks.rolled import make_rollout_material
from cconv.evaluation.rollout_errors import rollout_errors
from cconv.rollout.rollout import Diverged, rollout
from cconv.rollout.solver_model import SolverModel
from cconv.scenes import scene_named
from cconv.scenes.find import find_scene
from cconv.tasks import task_named
from cconv.tasks.samples import make_step_sample

TASK = task_named("acceleration", history=3)
pytestmark = pytest.mark.integration


@pytest.fixture(scope="module", params=["taylor_green_2d", "lid_driven_cavity_2d", "dam_break_2d"])
def case(request, tmp_path_factory):
    """A small data set, and the solver as a model of it"""
    folder = tmp_path_factory.mktemp(request.param) / "data"
    generate(scene_named(request.param, "small"), folder, num_trajectories=1, num_frames=32, workers=1)
    dataset = open_dataset(folder)
    return dataset, SolverModel(find_scene(dataset.metadata).scene, TASK)


def test_its_rollout_is_the_solvers_own_frames_and_near_the_stored_ones(case):
    dataset, model = case
    start = window_at(dataset.trajectory("train", 0), 4, 3, 4)
    rolled = torch.stack([window.present for window in islice(rollout(model, start, dataset.scene), 4)])
    simulated = find_scene(dataset.metadata).scene
    solved = torch.stack([window.present for window in islice(solved_frames(simulated, start), 4)])
    apart = dataset.scene.box.displacement(rolled, solved)
    assert apart.abs().max() < 1e-5 * dataset.scene.particle_spacing
    found = rollout_errors(model.predict_frame, make_step_sample(start, dataset.scene, TASK))
    assert found.diverged is None
    assert found.errors[-1] ** 0.5 < 0.03 * dataset.scene.particle_spacing


def test_it_begins_anew_from_another_start(case):
    dataset, model = case
    trajectory = dataset.trajectory("train", 0)
    first, other = (window_at(trajectory, present, 3, 1) for present in (3, 5))
    once, _, again = (model.predict_frame(window, dataset.scene) for window in (first, other, first))
    assert torch.equal(once, again)


@pytest.fixture(scope="module")
def material(case):
    """Starts of rollouts that the solver can go on from: its scene has one size, and its walls stay where they are."""
    dataset, _ = case
    all_starts = make_rollout_material([dataset.trajectory("train", 0)], dataset.scene, TASK)
    impossible = {"scaled", "turned", "mirrored"} if dataset.scene.has_boundary else {"scaled"}
    return replace(all_starts, others=tuple(each for each in all_starts.others if each.name not in impossible))


@pytest.mark.parametrize("check", TASK.checks)
def test_it_passes_every_check(check, case, material):
    for finding in CHECKS[check](material).findings(case[1]):
        assert finding.value <= finding.limit, finding


def test_a_simulation_that_blows_up_is_a_rollout_that_diverged(case):
    dataset, model = case
    start = window_at(dataset.trajectory("train", 0), 4, 3, 1)
    positions = start.positions.double()
    positions[-2, start.is_fluid] += 0.4 * dataset.scene.box.lengths[0]
    broken = replace(start, positions=positions)
    for _ in range(2):
        with pytest.raises(Diverged, match="the rollout diverged at frame 5: The simulation blew up"):
            model.predict_frame(broken, dataset.scene)
