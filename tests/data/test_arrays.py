"""Arrays become a data set that reads back as what was given, and what cannot be one is refused by name."""

import json

import numpy as np
import pytest
import torch

import cconv
from cconv.data.arrays import split_runs
from cconv.errors import ConfigError, DataError, ShapeError

FACTS = cconv.SceneFacts(particle_spacing=0.1, frame_dt=0.5, force=(0.0, -9.81))


def arrays(seed=0, frames=9, particles=10, **more):
    """Random particles in two dimensions."""
    rng = np.random.default_rng(seed)
    return cconv.ParticleArrays(
        positions=rng.random((frames, particles, 2)), velocities=rng.random((frames, particles, 2)), **more
    )


def test_what_is_written_is_read_again(tmp_path):
    given = [
        arrays(seed, masses=np.full(10, 2.0), particle_types=[0] * 8 + [1] * 2, viscosities=np.full(10, 0.1))
        for seed in range(3)
    ]
    box = cconv.Box((0, 0), (1, 1), (True, False))
    facts = cconv.SceneFacts(particle_spacing=0.1, frame_dt=0.5, force=(0.0, -9.81), box=box, name="mine")
    cconv.write_dataset(tmp_path / "a", given, facts)
    dataset = cconv.open_dataset(tmp_path / "a")
    assert (dataset.scene.name, dataset.scene.box, dataset.scene.frame_dt) == ("mine", box, 0.5)
    assert dataset.scene.force.declaration()["acceleration"] == (0.0, -9.81)
    assert dataset.scene.missing == ()
    read = [dataset.trajectory(split, 0) for split in dataset.splits]
    for trajectory in read:
        (same,) = [each for each in given if np.array_equal(each.positions, trajectory.positions)]
        assert np.array_equal(same.velocities, trajectory.velocities)
        assert trajectory.masses.tolist() == [2.0] * 10
        assert trajectory.viscosities.tolist() == [0.1] * 10
        assert trajectory.particle_types.tolist() == [0] * 8 + [1] * 2
        assert len(trajectory.boundary.positions) == 2
    assert len({tuple(each.positions.ravel().tolist()) for each in read}) == 3


def test_a_single_run_is_cut_in_time_with_a_gap(tmp_path):
    (given,) = [arrays()]
    cconv.write_dataset(tmp_path / "a", [given], FACTS)
    parts = [cconv.open_dataset(tmp_path / "a").trajectory(split, 0).positions for split in ("train", "valid", "test")]
    for part, block in zip(parts, (slice(0, 3), slice(5, 6), slice(8, 9)), strict=True):
        assert np.array_equal(part, given.positions[block])


def test_what_is_not_given_is_said_to_be_missing(tmp_path):
    bare = cconv.ParticleArrays(positions=torch.rand(9, 10, 3).numpy())
    cconv.write_dataset(tmp_path / "a", [bare], cconv.SceneFacts(particle_spacing=0.1, frame_dt=0.5))
    scene = cconv.open_dataset(tmp_path / "a").scene
    assert [line.partition(":")[0] for line in scene.missing] == ["velocities", "masses", "force"]
    low, high = bare.positions.min(axis=(0, 1)) - 0.05, bare.positions.max(axis=(0, 1)) + 0.05
    np.testing.assert_allclose([scene.box.lower, scene.box.upper], [low, high])


def test_points_of_walls_are_kept_with_their_normals(tmp_path):
    points, normals = np.random.default_rng(0).random((2, 4, 2))
    cconv.write_dataset(tmp_path / "a", [arrays(boundary_positions=points, boundary_normals=normals)], FACTS)
    boundary = cconv.open_dataset(tmp_path / "a").trajectory("test", 0).boundary
    assert np.array_equal(boundary.positions, points)
    assert np.array_equal(boundary.normals, normals)


def test_trajectories_of_a_run_stay_in_one_split(tmp_path):
    names = [name for name in "abcde" for _ in range(3)]
    cconv.write_dataset(tmp_path / "a", [arrays(k, frames=1) for k in range(15)], FACTS, runs=names)
    runs = json.loads((tmp_path / "a" / "metadata.json").read_text())["cconv"]["runs"]
    assert sorted(name for part in runs.values() for name in part) == list("abcde")


@pytest.mark.parametrize("gap", [0, 2])
def test_trajectories_of_the_only_run_are_cut_in_time_with_a_gap(tmp_path, gap):
    blocks = split_runs(["a"] * 20, lambda _: 1, ((0.6, 0.2, 0.2), gap, 0), tmp_path)
    numbers = {split: [int(block.trajectory) for block in each] for split, each in blocks.items()}
    assert numbers["train"][0] == 0
    assert numbers["valid"][0] - numbers["train"][-1] == numbers["test"][0] - numbers["valid"][-1] == gap + 1
    assert numbers["test"][-1] == 19


@pytest.mark.parametrize(
    ("damage", "words"),
    [
        ({"positions": np.zeros((4, 5))}, "`positions` must have shape .frames, particles, dim.*got .4, 5."),
        ({"positions": np.zeros((4, 5, 4))}, "dim 1 to 3"),
        ({"velocities": np.zeros((9, 9, 2))}, "`velocities` must have shape .9, 10, 2., got .9, 9, 2."),
        ({"masses": np.full(10, np.nan)}, "`masses` has a NaN"),
        ({"masses": np.array(["a"] * 10)}, "`masses` must be numbers"),
        ({"particle_types": [7] * 10}, r"unknown values \[7\]; known are -1 \(pad\), 0 \(fluid\)"),
        ({"particle_types": [1] * 10}, "no fluid"),
        ({"boundary_positions": np.zeros((3, 3))}, "`boundary_positions` must have shape .3, 2."),
        ({"boundary_normals": np.zeros((3, 2))}, "`boundary_normals` must have shape .0, 2."),
    ],
)
def test_arrays_that_do_not_fit_are_refused(damage, words):
    fine = {"positions": np.ones((9, 10, 2)), "velocities": np.ones((9, 10, 2))}
    with pytest.raises((ShapeError, ConfigError), match=words):
        cconv.ParticleArrays(**(fine | damage))


@pytest.mark.parametrize(
    ("trajectories", "said", "words"),
    [
        ([], {}, "at least one trajectory"),
        ([arrays(), arrays()], {}, "2 trajectories, too few for 3 splits"),
        ([arrays(frames=3)], {}, "at least 7 are needed"),
        ([arrays(), arrays(), arrays(masses=np.ones(10))], {}, "has `masses`, unlike the first one"),
        ([arrays(), arrays(), cconv.ParticleArrays(positions=np.ones((9, 4, 3)))], {}, "3 dimensions, the first one 2"),
        ([arrays()], {"runs": ["a", "b"]}, "one name a trajectory .1., got 2"),
        ([arrays()], {"split_fractions": (0.5, 0.5, 0.5)}, "must sum to 1"),
    ],
)
def test_trajectories_that_do_not_fit_are_refused_and_leave_nothing(tmp_path, trajectories, said, words):
    with pytest.raises((ShapeError, ConfigError, DataError), match=words):
        cconv.write_dataset(tmp_path / "a", trajectories, FACTS, **said)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(("name", "value"), [("particle_spacing", 0.0), ("frame_dt", -1.0), ("force", (1e20, 0.0))])
def test_facts_that_cannot_be_are_refused(name, value):
    with pytest.raises(ConfigError, match=name):
        cconv.SceneFacts(**({"particle_spacing": 0.1, "frame_dt": 0.5} | {name: value}))


def test_a_box_or_force_of_other_dimensions_is_refused(tmp_path):
    for facts in ({"box": cconv.Box((0,) * 3, (1,) * 3)}, {"force": (0.0, 0.0, 1.0)}):
        with pytest.raises((ShapeError, ConfigError), match="axes|axis"):
            cconv.write_dataset(
                tmp_path / "a", [arrays()], cconv.SceneFacts(particle_spacing=0.1, frame_dt=0.5, **facts)
            )
