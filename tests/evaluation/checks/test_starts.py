"""Other starts are the states that they say, and mapped flows are the same flows."""

from dataclasses import replace

import pytest
import torch
from systems import configured, periodic_frame, periodic_scene, window_of, with_walls

from cconv.data.trajectory import ParticleType, Trajectory
from cconv.domain import Box
from cconv.evaluation.checks.mapped_starts import MappedStarts
from cconv.evaluation.checks.rolled import make_rollout_material
from cconv.evaluation.checks.starts import other_starts
from cconv.forces import ConstantForce, ReversePoiseuilleForce
from cconv.models.model import build_model
from cconv.networks import ARCHITECTURES
from cconv.tasks import task_named
from cconv.tasks.samples import make_step_sample

HISTORY, FRAMES = 3, 5
TASK = task_named("acceleration", history=HISTORY)


@pytest.fixture
def scene():
    """A box of twice the height of its width, open above, under gravity."""
    return replace(periodic_scene(12), box=Box([1, 0], [2, 2], (True, False)), force=ConstantForce((0.3, -1.0)))


@pytest.fixture
def trajectory(generator, scene):
    """Smooth motion above a row of wall particles, with wall points."""
    frame = with_walls(periodic_frame(generator, 12))
    shifted = replace(
        frame,
        positions=frame.positions + torch.tensor([1.0, 0.0]),
        particle_types=torch.where(frame.positions[:, 1] < 0.1, int(ParticleType.SOLID_WALL), 0),
    )
    window = window_of(shifted, generator, HISTORY + FRAMES + 4)
    return Trajectory(
        name="0",
        first_frame=0,
        positions=window.positions,
        velocities=torch.zeros_like(window.positions),
        masses=window.masses,
        particle_types=window.particle_types,
        boundary=window.boundary,
    )


@pytest.fixture
def starts(trajectory, scene):
    return {each.name: each for each in other_starts(trajectory, scene, HISTORY, FRAMES)}


def nearest(positions, box):
    apart = box.displacement(positions[:, None], positions[None]).norm(dim=2)
    return apart.fill_diagonal_(torch.inf).amin(dim=1)


@pytest.mark.parametrize("name", ["shaken", "squeezed"])
def test_disorder_moves_fluid_alone_and_changes_no_velocity(name, starts, trajectory, scene):
    window, stored = starts[name].window, trajectory.positions[:HISTORY].double()
    shift = scene.box.displacement(window.positions, stored)
    torch.testing.assert_close(shift, shift[:1].expand_as(shift))
    assert shift[0, window.is_fluid].norm(dim=1).max() > 0.05 * scene.particle_spacing
    assert not shift[0, ~window.is_fluid].any()
    assert torch.equal(window.future, trajectory.positions[HISTORY : HISTORY + FRAMES])


def test_shaken_particles_are_off_by_a_twentieth_of_a_spacing(starts, trajectory, scene):
    window = starts["shaken"].window
    shift = scene.box.displacement(window.present, trajectory.positions[HISTORY - 1].double())[window.is_fluid]
    assert shift.square().mean().sqrt() == pytest.approx(0.05 * scene.particle_spacing, rel=0.1)


def test_squeezed_fluid_is_denser_within_and_as_it_was_outside(starts, trajectory, scene):
    window, stored = starts["squeezed"].window, trajectory.positions[HISTORY - 1].double()
    middle = stored[window.is_fluid].mean(dim=0)
    places = (stored, window.present)
    radius = [scene.box.displacement(each, middle).norm(dim=1) / scene.particle_spacing for each in places]
    within = window.is_fluid & (radius[0] < 4)
    assert (radius[1][within] <= radius[0][within]).all()
    inner = radius[0] < 1
    assert inner.any()
    assert (radius[1][inner] < 0.93 * radius[0][inner]).all()
    assert (radius[1] >= 0.9 * radius[0] - 1e-9).all()
    assert torch.equal(window.present[~within], scene.box.wrap(stored)[~within])


def test_the_later_start_ends_with_the_trajectory(starts, trajectory):
    window = starts["later"].window
    assert window.frame == len(trajectory) - 1 - FRAMES
    assert torch.equal(window.future, trajectory.positions[-FRAMES:])


@pytest.mark.parametrize("name", ["scaled", "mirrored", "turned"])
def test_a_mapped_flow_has_the_same_distances_in_spacings(name, starts, trajectory, scene):
    start, stored = starts[name], trajectory.positions[HISTORY - 1].double()
    found = nearest(start.window.present, start.scene.box) / start.scene.particle_spacing
    torch.testing.assert_close(found, nearest(stored, scene.box) / scene.particle_spacing)
    walls = start.window.boundary
    assert walls.normals.norm(dim=1) == pytest.approx(1)
    apart, before = (
        (points.positions[:, None] - places).norm(dim=2).amin(dim=0) / spacing
        for points, places, spacing in (
            (walls, start.window.present, start.scene.particle_spacing),
            (trajectory.boundary, scene.box.wrap(stored), scene.particle_spacing),
        )
    )
    assert apart.median() == pytest.approx(float(before.median()), rel=1e-4)
    assert start.scene.box.lower == scene.box.lower
    assert sum(start.scene.box.periodic) == 1


def test_a_quarter_of_a_turn_swaps_the_axes_of_the_box_and_turns_the_force(starts, scene):
    turned = starts["turned"].scene
    assert turned.box == Box([1, 0], [3, 1], (False, True))
    expected = {"turned": (1.0, 0.3), "mirrored": (-0.3, -1.0), "scaled": (0.45, -1.5)}
    somewhere = torch.ones(1, 2, dtype=torch.float64)
    for name, force in expected.items():
        assert starts[name].scene.force(somewhere)[0].tolist() == pytest.approx(force)


@pytest.mark.parametrize("architecture", ARCHITECTURES)
def test_rollouts_of_equivariant_networks_turn_with_the_flow_and_all_scale_with_it(architecture, generator):
    scene = periodic_scene()
    window = window_of(periodic_frame(generator), generator, HISTORY, FRAMES)
    stored = Trajectory(
        name="0",
        first_frame=0,
        positions=torch.cat([window.positions, window.future]),
        velocities=torch.zeros(HISTORY + FRAMES, 64, 2),
        masses=window.masses,
        particle_types=window.particle_types,
        boundary=None,
    )
    network = configured(architecture=architecture, layers=2, first_channels=4, kernel_size=3, radial_terms=5).network
    sample = make_step_sample(window, scene, TASK)
    model = build_model(network, TASK, TASK.features, scene, [sample], generator)
    with torch.no_grad():
        for parameter in model.parameters():
            parameter.add_(0.1 * torch.randn(parameter.shape, generator=generator))
        model.target_scale.mul_(0.1)  # so that answers feed back on themselves without amplifying what is rounded
    check = MappedStarts(make_rollout_material([stored], scene, TASK))
    found = {each.label: each.value for each in check.findings(model)}
    assert found["scaled"] < 1e-3
    for name in ("turned", "mirrored"):
        assert (found[name] < 1e-3) == network.is_equivariant


def test_a_force_that_depends_on_the_position_is_mapped_with_the_place_it_acts_at(trajectory, scene):
    force = ReversePoiseuilleForce(magnitude=0.5, height=1.0)
    begun = {each.name: each for each in other_starts(trajectory, replace(scene, force=force), 3, 2)}
    for name in ("turned", "mirrored", "scaled"):
        mapping, mapped = begun[name].mapping, begun[name].scene.force
        points = 0.7 + torch.rand(20, 2, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
        torch.testing.assert_close(mapped(mapping(points)), mapping.of_vectors(force(points)))
