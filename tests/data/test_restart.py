"""Restarts of the solver from stored frames go on as the simulation did."""

from dataclasses import replace
from itertools import islice

import pytest
import torch
from systems import still_window

from cconv.data.dataset import open_dataset
from cconv.data.generate import generate
from cconv.data.restart import restart, solved_frames
from cconv.data.window import window_at
from cconv.errors import DataError, ShapeError, SimulationError
from cconv.evaluation.rollout_metrics import squared_errors
from cconv.scenes import SCENES, scene_named
from cconv.scenes.find import find_scene

FUTURE, PRESENT = 3, 4
# Summed densities follow from positions, so that few steps tell enough; pressure of evolved ones has to build up.
QUICK = {"relaxation_steps": 20, "steps_per_frame": 5, "skipped_frames": 2}


def stored(name, folder, num_frames=16):
    """The found scene and the first trajectory of a small data set, cut in time: the half of its frames."""
    settings = QUICK if SCENES[name].density_scheme == "summation" else {}
    generate(scene_named(name, "small", **settings), folder, num_trajectories=1, num_frames=num_frames, workers=1)
    dataset = open_dataset(folder)
    trajectory, (scene, reason) = dataset.trajectory("train", 0), find_scene(dataset.metadata)
    assert reason == ""
    if trajectory.viscosities is not None:
        scene = replace(scene, viscosity=float(trajectory.viscosities[0]))
    return scene, trajectory


def errors(windows, start, scene):
    """Root mean square errors in each frame after a start, of all particles, in particle spacings."""
    positions = torch.stack([window.present for window in islice(windows, len(start.future))])
    return squared_errors(positions, start.future, scene.box).sqrt() / scene.particle_spacing


def uniform_motion(start, velocities, scene):
    window = start
    while True:
        window = window.followed_by(scene.box.wrap(window.present.double() + scene.frame_dt * velocities).float())
        yield window


@pytest.mark.integration
@pytest.mark.parametrize("name", SCENES)
def test_the_solver_goes_on_from_a_stored_frame(name, tmp_path):
    scene, trajectory = stored(name, tmp_path / "data")
    start, velocities = window_at(trajectory, PRESENT, PRESENT + 1, FUTURE), trajectory.velocities[PRESENT]
    found = errors(solved_frames(scene, start, velocities), start, scene)
    straight = errors(uniform_motion(start, velocities, scene), start, scene)
    if scene.density_scheme == "summation":
        assert found.max() < 1e-5  # what rounding to float32 leaves
        assert (found < 1e-2 * straight).all()
    else:
        assert found.max() < 0.01
        assert (found < straight).all()
        assert found[-1] < max(0.2 * straight[-1], 0.005)  # still water hardly moves
    from_differences = errors(solved_frames(scene, start), start, scene)
    assert from_differences[-1] < 0.5 * straight[-1]


@pytest.mark.integration
@pytest.mark.parametrize("name", ["lid_driven_cavity_2d", "lid_driven_cavity_3d", "dam_break_2d"])
def test_walls_are_where_they_are_stored_and_in_full_whatever_their_order(name, tmp_path):
    scene, trajectory = stored(name, tmp_path / "data", num_frames=8)
    order = torch.randperm(trajectory.positions.shape[1], generator=torch.Generator().manual_seed(0))
    window = window_at(trajectory, 1, 2, 2)
    start = replace(
        window,
        positions=window.positions[:, order],
        future=window.future[:, order],
        particle_types=window.particle_types[order],
        masses=window.masses[order],
    )
    velocities = trajectory.velocities[1, order]
    begun = restart(scene, start, velocities)
    state = begun.state
    torch.testing.assert_close(state.positions[begun.places], start.present.double(), rtol=0, atol=1e-6)
    torch.testing.assert_close(state.velocities[begun.places], velocities.double(), rtol=0, atol=1e-6)
    assert torch.equal(state.is_wall[begun.places], ~start.is_fluid)
    assert int(state.is_wall.sum()) == len(scene.walls)
    following = next(solved_frames(scene, start, velocities))
    walls = ~start.is_fluid
    apart = scene.box.displacement(following.present[walls], start.future[0, walls].double())
    assert apart.abs().max() < 1e-5 * scene.particle_spacing
    assert (following.frame, len(following.positions)) == (2, 2)


def dam_break():
    """Two equal frames of a dam break at rest, whose right wall is a third of a spacing off, as in LagrangeBench."""
    scene = scene_named("dam_break_2d", "small", relaxation_steps=5, steps_per_frame=2)
    walls = scene.walls.positions[scene.walls.stored]
    right = walls[:, 0] > walls[:, 0].max() - 0.5 * scene.particle_spacing
    walls[right, 0] += 0.3 * scene.particle_spacing
    fluid, _ = scene.fluid(torch.Generator().manual_seed(0))
    return scene, still_window(walls.float(), fluid.float())


def test_layers_that_are_not_stored_follow_those_that_are():
    scene, start = dam_break()
    walls, state = scene.walls, restart(scene, start).state
    moved = (state.positions[state.is_wall] - walls.positions)[:, 0] / scene.particle_spacing
    right = walls.positions[:, 0] > scene.wall_thickness + scene.tank[0]
    torch.testing.assert_close(moved, torch.where(right, 0.3, 0.0).double(), rtol=0, atol=1e-5)


def test_particles_may_nearly_coincide_amid_a_flow():
    scene, start = dam_break()
    positions = start.positions.clone()
    positions[:, -1] = positions[:, -2] + 1e-3 * scene.particle_spacing
    assert torch.isfinite(next(solved_frames(scene, replace(start, positions=positions))).present).all()


def test_walls_of_another_scene_are_refused():
    scene, start = dam_break()
    fewer = replace(start, positions=start.positions[:, 1:], particle_types=start.particle_types[1:])
    with pytest.raises(DataError, match="stores"):
        restart(scene, fewer)
    positions = start.positions.clone()
    positions[:, 0] += scene.particle_spacing
    with pytest.raises(DataError, match="do not lie where dam_break_2d has its own"):
        restart(scene, replace(start, positions=positions))


def test_a_single_frame_needs_velocities():
    scene, start = dam_break()
    single = replace(start, positions=start.positions[1:])
    with pytest.raises(ShapeError, match="at least 2 frames"):
        restart(scene, single)
    assert restart(scene, single, torch.zeros_like(single.present)).state.velocities.abs().max() == 0


def test_a_restart_can_blow_up():
    scene, start = dam_break()
    with pytest.raises(SimulationError):
        next(solved_frames(scene, start, torch.full_like(start.present, 1e6)))
