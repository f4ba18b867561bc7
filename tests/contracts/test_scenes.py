"""What every scene must hold, and every task on it; a new one is held to it by being in its folder's list."""

import json
from dataclasses import replace
from itertools import islice

import pytest
import torch
from contracts.registered import registered

from cconv.data.dataset import open_dataset
from cconv.data.generate import generate
from cconv.data.hdf5 import write_splits
from cconv.data.window import Windows
from cconv.domain import Box
from cconv.evaluation.rollout_metrics import squared_errors
from cconv.rollout.rollout import advance
from cconv.scenes import SCENES, scene_named
from cconv.scenes.find import find_scene
from cconv.scenes.simulated_scene import SimulatedScene
from cconv.tasks import TASKS, task_named
from cconv.tasks.integrators import SemiImplicitEuler
from cconv.tasks.task import FieldTask

LAGRANGEBENCH_KEYS = {
    "case", "solver", "density_evolution", "dim", "dx", "dt", "t_end", "viscosity", "p_bg_factor", "g_ext_magnitude",
    "artificial_alpha", "free_slip", "write_every", "is_bc_trick", "sequence_length_train", "num_trajs_train",
    "sequence_length_test", "num_trajs_test", "num_particles_max", "periodic_boundary_conditions", "bounds",
    "default_connectivity_radius", "vel_mean", "vel_std", "acc_mean", "acc_std",
}  # fmt: skip
scenes = pytest.mark.parametrize("name", SCENES)


def test_every_scene_of_the_folder_is_in_its_list():
    assert registered("scenes", SimulatedScene) == set(SCENES.values())
    assert all(scene.name == name for name, scene in SCENES.items())


def are_inside(positions, box):
    """Whether positions lie in a box, bounds included."""
    lower, upper = (torch.tensor(corner, dtype=positions.dtype) for corner in (box.lower, box.upper))
    return bool(((positions >= lower) & (positions <= upper)).all())


@pytest.mark.integration
@scenes
def test_a_small_scene_runs_within_its_box_and_says_what_it_has(name, generator):
    scene = scene_named(name, "small", relaxation_steps=50)
    solver, state = scene.solver(), scene.initial_state(generator)
    walls = state.positions[state.is_wall]
    for _ in range(60):
        state = solver.step(state, scene.time_step)
    fluid = ~state.is_wall
    assert are_inside(state.positions[fluid], scene.box)
    assert bool(state.is_wall.any()) == scene.features["walls"]
    assert bool(state.velocities[state.is_wall].any()) == scene.features["moving_walls"]
    assert bool((state.positions[state.is_wall] != walls).any()) == scene.features["moving_walls"]
    assert any(scene.box.periodic) == scene.features["periodic"]
    assert state.velocities[fluid].norm(dim=1).max() < 0.3 * scene.equation_of_state.sound_speed
    assert ((state.densities[fluid] / scene.rest_density - 1).abs() < 0.1).all()
    if scene.force is not None:
        force = scene.force(state.positions)
        assert force.shape == state.positions.shape
        assert float(force.norm(dim=1).max()) == pytest.approx(scene.largest_force)


@scenes
def test_the_same_seed_gives_the_same_start_and_another_seed_another(name):
    scene = scene_named(name, "small", relaxation_steps=5)
    first, again, other = (scene.initial_state(torch.Generator().manual_seed(seed)).positions for seed in (1, 1, 2))
    assert torch.equal(first, again)
    assert first.shape != other.shape or not torch.equal(first, other)


@pytest.mark.parametrize("name", [name for name in SCENES if any(scene_named(name, "small").box.periodic)])
def test_a_scene_moved_along_a_periodic_axis_is_stepped_the_same(name, generator):
    """Also where forces depend on the place: they do not along the first of these axes."""
    scene = scene_named(name, "small", relaxation_steps=5)
    solver, start = scene.solver(), scene.initial_state(generator)
    shift = torch.zeros(scene.dim, dtype=torch.float64)
    shift[scene.box.periodic.index(True)] = 0.37 * max(scene.box.lengths)
    others = start.velocities, start.masses, start.viscosities, start.is_wall
    plain, moved = (
        solver.step(solver.initial_state(start.positions + by, *others), scene.time_step) for by in (0 * shift, shift)
    )
    apart = scene.box.displacement(moved.positions, plain.positions + shift)
    torch.testing.assert_close(apart, torch.zeros_like(apart), rtol=0, atol=1e-9 * scene.particle_spacing)
    torch.testing.assert_close(moved.velocities, plain.velocities, rtol=0, atol=1e-9 * scene.reference_speed)


@pytest.fixture(scope="module", params=SCENES)
def scene(request):
    """A scene at its small size, made quickly."""
    return scene_named(request.param, "small", relaxation_steps=5, steps_per_frame=2, skipped_frames=0)


@pytest.fixture(scope="module")
def dataset(scene, tmp_path_factory):
    """A small data set of the scene."""
    folder = tmp_path_factory.mktemp(scene.name) / "data"
    generate(scene, folder, num_trajectories=1 if scene.num_trajectories == 1 else 3, num_frames=10, workers=1)
    return open_dataset(folder)


@pytest.mark.integration
def test_a_scene_becomes_a_data_set_that_says_what_it_is(scene, dataset):
    metadata = json.loads((dataset.path / "metadata.json").read_text())
    assert set(metadata) == LAGRANGEBENCH_KEYS | {"cconv"}
    assert metadata["cconv"]["features"] == scene.features
    assert dataset.scene.name == scene.name
    assert (dataset.scene.box, dataset.scene.particle_spacing) == (scene.box, scene.particle_spacing)
    assert dataset.scene.velocity_source == dataset.scene.mass_source == "stored"
    assert dataset.scene.has_boundary == scene.features["walls"]
    assert dataset.scene.frame_dt == pytest.approx(scene.frame_dt)
    assert dataset.scene.force == scene.force
    assert not dataset.scene.missing
    trajectory = dataset.trajectory("test", 0)
    assert (trajectory.viscosities is not None) == scene.features["varying_viscosity"]
    assert torch.isfinite(trajectory.velocities).all()
    assert are_inside(trajectory.positions[:, trajectory.particle_types == 0], scene.box)


@pytest.mark.integration
def test_the_scene_of_a_data_set_is_found(scene, dataset):
    found, reason = find_scene(dataset.metadata)
    assert reason == ""
    not_stored = ("num_frames", "skipped_frames", "num_trajectories", "relaxation_steps")
    assert replace(found, **{name: getattr(scene, name) for name in not_stored}) == scene


@pytest.mark.integration
def test_what_a_data_set_says_survives_another_writing(dataset, tmp_path):
    splits = {split: list(dataset.trajectories(split)) for split in dataset.splits}
    write_splits(tmp_path / "again", dataset.scene, splits, dataset.metadata)
    again = open_dataset(tmp_path / "again")
    assert again.scene == dataset.scene
    assert again.metadata == dataset.metadata


@pytest.mark.integration
@pytest.mark.parametrize("task", [name for name, task in TASKS.items() if issubclass(task, FieldTask)])
def test_a_field_moves_with_the_scene(task, dataset, generator):
    """With the box; and within it, where what leaves through a periodic face comes back at the other."""
    asked, scene, frame = task_named(task), dataset.scene, dataset.trajectory("test", 0)[-1]
    positions, shift = frame.positions.double(), 3.7 * torch.rand(scene.dim, generator=generator).double()

    def field(positions, box):
        return asked.field(asked.state(replace(frame, positions=positions), replace(scene, box=box)))

    expected = field(positions, scene.box)
    assert torch.isfinite(expected).all()
    lower, upper, lengths, periodic = (
        torch.tensor(each, dtype=torch.float64)
        for each in (scene.box.lower, scene.box.upper, scene.box.lengths, scene.box.periodic)
    )
    turns = torch.randint(-1, 2, positions.shape, generator=generator)
    tolerance = {"rtol": 1e-9, "atol": 1e-9 * float(expected.abs().max())}
    for moved, box in (
        (positions + shift, Box(lower + shift, upper + shift, scene.box.periodic)),
        (scene.box.wrap(positions + shift), scene.box),
        (positions + turns * lengths * periodic, scene.box),
    ):
        torch.testing.assert_close(field(moved, box), expected, **tolerance)


@pytest.mark.integration
def test_a_rollout_of_targets_is_the_stored_trajectory(dataset):
    """The law of integrators, for walls and lids too, which move as prescribed."""
    scene, trajectory = dataset.scene, dataset.trajectory("train", 0)
    euler, (start, *_) = SemiImplicitEuler(), Windows([trajectory], 2, len(trajectory) - 2)
    replayed = islice(advance(euler.target, euler, start, scene), len(start.future))
    positions = torch.stack([window.present for window in replayed])
    assert squared_errors(positions, start.future, scene.box).sqrt().max() < 1e-5 * scene.particle_spacing
