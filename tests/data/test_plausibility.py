"""Data that can be read and make no sense are named, with frame and particle; what a solver wrote is not."""

import json
import re
import shutil
from dataclasses import replace

import pytest
import torch
from particle_files import write_hdf5

from cconv.data.dataset import open_dataset
from cconv.data.fluid_checks import CHECKS
from cconv.data.plausibility import dataset_findings, refuse_nonsense, trajectory_findings
from cconv.data.trajectory import ParticleType, Scene, Trajectory
from cconv.domain import Box
from cconv.errors import DataError

SPACING, FRAME_DT, FRAMES = 0.1, 0.02, 6
OTHER_CASES = {"spacing", "neighbors", "number_density"}  # which have tests of their own


def lattice(periodic=False, shift=0.0):
    """A square of 64 particles that moves along x by a fifth of its spacing a frame, and its scene."""
    ticks = 0.45 + SPACING * torch.arange(8, dtype=torch.float64)
    start = torch.cartesian_prod(ticks, ticks)
    step = torch.tensor([0.2 * SPACING, 0.0], dtype=torch.float64)
    scene = Scene(
        name="lattice",
        dim=2,
        particle_spacing=SPACING,
        frame_dt=FRAME_DT,
        box=Box((0.0, 0.0), (2.0, 2.0), periodic),
        force=None,
        has_boundary=True,
        velocity_source="stored",
        mass_source="stored",
        missing=(),
    )
    positions = start + shift + torch.arange(FRAMES)[:, None, None] * step
    trajectory = Trajectory(
        name="train/00000",
        first_frame=10,
        positions=scene.box.wrap(positions),
        velocities=(step / FRAME_DT).expand(FRAMES, 64, 2).clone(),
        masses=torch.full((64,), SPACING**2, dtype=torch.float64),
        particle_types=torch.zeros(64, dtype=torch.int64),
        boundary=None,
    )
    return trajectory, scene


def zero_mass(trajectory):
    trajectory.masses[5] = 0.0


def negative_mass(trajectory):
    trajectory.masses[5] = -1.0


def never_written(trajectory):
    trajectory.positions[3:] = 0.0


def frozen(trajectory):
    trajectory.positions[3] = trajectory.positions[2]


def outside(trajectory):
    trajectory.positions[3, 5, 1] = 2.2


def lost(trajectory):
    trajectory.positions[3:, 5, 1] += 40.0


def crossing(trajectory):
    trajectory.positions[3:, 5, 1] += 1.1


def exploded(trajectory):
    trajectory.velocities[3, 5] *= 200


def same_place(trajectory):
    trajectory.positions[0, 6] = trajectory.positions[0, 5]


def other_units(trajectory):
    trajectory.velocities.mul_(FRAME_DT)


def clumped(trajectory):
    rows = trajectory.positions[0].reshape(8, 8, 2)
    rows[2:5, 2:5] += 0.8 * (rows[3, 3] - rows[2:5, 2:5])


def in_another_order(trajectory):
    trajectory.positions[3:] = trajectory.positions[3:].roll(9, dims=1)


def no_velocities(trajectory):
    trajectory.velocities.zero_()


@pytest.mark.parametrize(
    ("check", "damage", "frame", "particle", "words"),
    [
        ("masses", zero_mass, 10, 5, "mass 0 is not positive .1 fluid.*--mass"),
        ("masses", negative_mass, 10, 5, "mass -1"),
        ("zeros", never_written, 13, None, "in 3 frames: they were never written"),
        ("frozen", frozen, 13, None, "those of the frame before"),
        ("outside", outside, 13, 5, "2 particle spacings outside the box .1 fluid"),
        ("far", lost, 13, 5, "times as far from the middle"),
        ("crossing", crossing, 13, 5, "moves 1.1 along y.*not periodic.*periodic_boundary_conditions"),
        ("speeds", exploded, 13, 5, "times the mean"),
        ("compressed", clumped, 10, 18, "the density there is [0-9.]+ times that at rest .9 fluid"),
        ("jumps", in_another_order, 13, 0, "jumps [0-9.]+ times as far.*sort particles by their ids"),
        ("duplicates", same_place, 10, 5, "particle 6 is at the same place .2 fluid"),
        ("velocities", other_units, 10, None, "50 times as far.*--frame-dt"),
        ("velocities", no_velocities, 10, None, "inf times as far"),
    ],
)
def test_what_makes_no_sense_is_named_with_frame_and_particle(check, damage, frame, particle, words):
    trajectory, scene = lattice()
    damage(trajectory)
    found = {finding.check: finding for finding in trajectory_findings(trajectory, scene)}
    assert (found[check].frame, found[check].particle) == (frame, particle)
    assert re.search(words, str(found[check]))
    json.dumps(found[check].as_dict(), allow_nan=False)


def test_only_what_is_far_outside_is_named_where_there_are_no_walls():
    trajectory, scene = lattice()
    outside(trajectory)
    without_walls = replace(scene, has_boundary=False)
    assert "outside" not in [finding.check for finding in trajectory_findings(trajectory, without_walls)]
    trajectory.positions[3:] += 10.0
    assert "outside" in [finding.check for finding in trajectory_findings(trajectory, without_walls)]


@pytest.mark.parametrize("factor", [0.1, 0.4, 2.5, 10])
def test_a_spacing_that_does_not_fit_the_particles_is_named(factor):
    trajectory, scene = lattice()
    found = trajectory_findings(trajectory, replace(scene, particle_spacing=factor * SPACING))
    assert "spacing" in [finding.check for finding in found]


@pytest.mark.parametrize(("factor", "packed"), [(0.8, "0.64"), (1.3, "1.6[0-9]")])
def test_a_spacing_that_does_not_fit_the_number_of_particles_is_named(factor, packed):
    trajectory, scene = lattice(periodic=True)
    everywhere = torch.cartesian_prod(*[SPACING * torch.arange(20, dtype=torch.float64)] * 2).expand(2, -1, -1)
    full = replace(
        trajectory,
        positions=everywhere.clone(),
        velocities=torch.zeros_like(everywhere),
        masses=torch.full((400,), SPACING**2, dtype=torch.float64),
        particle_types=torch.zeros(400, dtype=torch.int64),
    )
    found = {each.check: each for each in trajectory_findings(full, replace(scene, particle_spacing=factor * SPACING))}
    assert re.search(f"the fluid is {packed}[0-9]* times as dense", str(found["number_density"]))
    assert f"give --particle-spacing {SPACING:.3g}" in str(found["number_density"])
    assert trajectory_findings(full, scene) == []


@pytest.mark.parametrize(
    ("factor", "words"), [(0.1, "have no neighbour within"), (60, "have about 1600 neighbours within")]
)
def test_no_neighbours_and_a_thousand_stop(factor, words):
    ticks = SPACING * torch.arange(40, dtype=torch.float64)
    positions = torch.cartesian_prod(ticks, ticks)[None]
    trajectory, scene = lattice()
    wide = replace(
        trajectory,
        positions=positions,
        velocities=torch.zeros_like(positions),
        masses=torch.ones(1600, dtype=torch.float64),
        particle_types=torch.zeros(1600, dtype=torch.int64),
    )
    found = trajectory_findings(wide, replace(scene, particle_spacing=factor * SPACING))
    (neighbors,) = [finding for finding in found if finding.check == "neighbors"]
    assert words in str(neighbors)
    assert neighbors.stops
    with pytest.raises(DataError, match="the data make no sense: trajectory train/00000, frame 10"):
        refuse_nonsense(found)


def test_what_is_only_suspicious_is_not_refused():
    trajectory, scene = lattice()
    same_place(trajectory)
    found = trajectory_findings(trajectory, scene)
    assert found
    refuse_nonsense(found)


def test_frames_that_two_splits_share_stop(tmp_path):
    write_hdf5(tmp_path, types=[0] * 9)
    shutil.copy(tmp_path / "train.h5", tmp_path / "test.h5")
    (found,) = [each for each in dataset_findings(open_dataset(tmp_path)) if each.check == "shared"]
    assert str(found).startswith("trajectory test/00000, frame 0: it is frame 0 of trajectory train/00000 in the train")
    assert found.stops


@pytest.mark.parametrize("shift", [0.0, 0.9])
def test_a_lattice_makes_sense_also_where_it_crosses_a_periodic_axis(shift):
    assert trajectory_findings(*lattice(periodic=True, shift=shift)) == []


def test_the_same_lattice_on_axes_that_are_not_periodic_crosses_them():
    trajectory, scene = lattice(periodic=True, shift=0.9)
    open_box = replace(scene, box=Box((0.0, 0.0), (2.0, 2.0)))
    assert "crossing" in [finding.check for finding in trajectory_findings(trajectory, open_box)]


def test_numbers_are_those_of_the_stored_particles():
    trajectory, scene = lattice()
    trajectory.particle_types[:4] = int(ParticleType.SOLID_WALL)
    trajectory.masses[:6] = 0.0  # what walls weigh says nothing
    (finding,) = trajectory_findings(trajectory, scene)
    assert (finding.check, finding.particle) == ("masses", 4)


def test_fluid_at_rest_and_a_single_particle_make_sense():
    trajectory, scene = lattice()
    still = replace(
        trajectory, positions=trajectory.positions[:1].repeat(4, 1, 1), velocities=torch.zeros(4, 64, 2).double()
    )
    assert trajectory_findings(still, scene) == []
    one = {name: getattr(trajectory, name)[:, :1] for name in ("positions", "velocities")}
    one |= {name: getattr(trajectory, name)[:1] for name in ("masses", "particle_types")}
    assert trajectory_findings(replace(trajectory, **one), scene) == []


def test_simulations_of_the_solver_make_sense(flow_folder):
    assert dataset_findings(open_dataset(flow_folder)) == []


def test_a_finding_that_many_trajectories_have_is_one_line(tmp_path):
    write_hdf5(tmp_path, mass=[1.0, 0.0, 1.0, 1.0])
    findings = dataset_findings(open_dataset(tmp_path))
    (masses,) = [finding for finding in findings if finding.check == "masses"]
    assert masses.others == 2
    assert str(masses).startswith("trajectory train/00000, frame 0, particle 1: ")
    assert str(masses).endswith("(and 2 more trajectories or blocks)")


def test_every_check_has_a_case():
    marks = test_what_makes_no_sense_is_named_with_frame_and_particle.pytestmark
    assert {case[0] for mark in marks for case in mark.args[1]} | OTHER_CASES == set(CHECKS)
