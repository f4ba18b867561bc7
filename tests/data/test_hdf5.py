import json
from dataclasses import replace

import h5py
import numpy as np
import pytest
import torch
from particle_files import METADATA, record_frames, write_hdf5, write_parts

from cconv.data.convert import convert
from cconv.data.dataset import open_dataset
from cconv.data.hdf5 import write_splits
from cconv.data.trajectory import finite_difference_velocities
from cconv.errors import ConfigError, DataError
from cconv.forces import ConstantForce, ReversePoiseuilleForce

SPLITS = ("train", "valid", "test")


def assert_same_trajectory(ours, theirs):
    for name in ("positions", "velocities", "masses", "particle_types", "viscosities"):
        one, other = getattr(ours, name), getattr(theirs, name)
        assert (one is None) == (other is None)
        if one is not None:
            assert one.dtype == other.dtype
            assert torch.equal(one, other)
    assert (ours.boundary is None) == (theirs.boundary is None)
    if ours.boundary is not None:
        assert torch.equal(ours.boundary.positions, theirs.boundary.positions)
        assert (ours.boundary.normals is None) == (theirs.boundary.normals is None)
        if ours.boundary.normals is not None:
            assert torch.equal(ours.boundary.normals, theirs.boundary.normals)


def stored(folder, key, split="train"):
    with h5py.File(folder / f"{split}.h5") as file:
        return file["00000"][key][()]


def test_plain_lagrangebench_set_is_read(tmp_path):
    write_hdf5(tmp_path)
    dataset = open_dataset(tmp_path)
    trajectory, scene = dataset.trajectory("valid", 0), dataset.scene
    assert np.array_equal(trajectory.positions.numpy(), stored(tmp_path, "position", "valid"))
    assert trajectory.particle_types.tolist() == [0, 0, 0, 0]
    assert trajectory.boundary is None
    assert (scene.dim, scene.particle_spacing, scene.force, scene.has_boundary) == (2, 0.1, None, False)
    assert scene.frame_dt == pytest.approx(0.01)
    assert (scene.box.lower, scene.box.upper, scene.box.periodic) == ((0.0, 0.0), (1.0, 2.0), (True, True))
    assert trajectory.masses.tolist() == pytest.approx([0.01] * 4)
    assert scene.mass_source == "1 * dx^2 = 0.01"


def test_missing_velocities_are_differences_across_the_periodic_edge(tmp_path):
    write_hdf5(tmp_path)
    dataset = open_dataset(tmp_path)
    trajectory, scene = dataset.trajectory("train", 0), dataset.scene
    expected = finite_difference_velocities(trajectory.positions, scene.frame_dt, scene.box)
    assert torch.equal(trajectory.velocities, expected)
    assert trajectory.velocities.abs().max() < 5
    assert scene.velocity_source == "central differences of positions"
    assert any(line.startswith("velocities:") for line in scene.missing)


def test_extras_are_read(tmp_path):
    velocity = np.random.default_rng(0).standard_normal((6, 4, 2)).astype("f4")
    walls, normals = np.array([[0.0, 0.0], [1.0, 0.0]], "f4"), np.array([[0.0, 1.0], [0.0, 1.0]], "f4")
    mass, viscosity = np.arange(1, 5, dtype="f4"), np.full(4, 0.5, "f4")
    write_hdf5(
        tmp_path, velocity=velocity, mass=mass, viscosity=viscosity, boundary_position=walls, boundary_normal=normals
    )
    dataset = open_dataset(tmp_path)
    trajectory = dataset.trajectory("train", 0)
    assert np.array_equal(trajectory.velocities.numpy(), velocity)
    assert np.array_equal(trajectory.masses.numpy(), mass)
    assert np.array_equal(trajectory.viscosities.numpy(), viscosity)
    assert np.array_equal(trajectory.boundary.positions.numpy(), walls)
    assert np.array_equal(trajectory.boundary.normals.numpy(), normals)
    assert (dataset.scene.velocity_source, dataset.scene.mass_source) == ("stored", "stored")
    assert dataset.scene.has_boundary


def test_wall_particles_are_the_boundary(tmp_path):
    write_hdf5(tmp_path, types=(0, 1, 0, 2))
    dataset = open_dataset(tmp_path)
    boundary = dataset.trajectory("train", 0).boundary
    assert np.array_equal(boundary.positions.numpy(), stored(tmp_path, "position")[0, [1, 3]])
    assert boundary.normals is None
    assert dataset.scene.has_boundary


def test_dam_break_has_gravity(tmp_path):
    write_hdf5(tmp_path, {"case": "DB", "g_ext_magnitude": 1.5})
    assert open_dataset(tmp_path).scene.force == ConstantForce((0.0, -1.5))


@pytest.mark.parametrize(("case", "force"), [("RPF", ReversePoiseuilleForce(1.5, 2.0)), ("other", None)])
def test_a_force_is_known_by_its_case_and_code_beside_the_data_not_run(tmp_path, case, force):
    write_hdf5(tmp_path, {"case": case, "g_ext_magnitude": 1.5, "bounds": [[0.0, 1.0], [0.0, 2.0]]})
    (tmp_path / "force.py").write_text("raise SystemExit('code found in data was run')")
    scene = open_dataset(tmp_path).scene
    assert scene.force == force
    assert any(line.startswith("force:") for line in scene.missing) == (force is None)


@pytest.mark.parametrize("force", [ConstantForce((0.5, -1.0)), ReversePoiseuilleForce(1.5, 2.0)])
def test_a_force_is_declared_by_name_and_read_again(tmp_path, force):
    write_hdf5(tmp_path / "a")
    dataset = open_dataset(tmp_path / "a")
    write_splits(
        tmp_path / "b",
        replace(dataset.scene, force=force),
        {split: dataset.trajectories(split) for split in dataset.splits},
    )
    stored = json.loads((tmp_path / "b" / "metadata.json").read_text())
    assert stored["cconv"]["force"]["name"] == force.name
    assert stored["g_ext_magnitude"] == force.largest
    assert open_dataset(tmp_path / "b").scene.force == force


def test_what_is_given_wins(tmp_path):
    write_hdf5(tmp_path, mass=np.ones(4, "f4"))
    dataset = open_dataset(tmp_path, mass=2.0, particle_spacing=0.5, frame_dt=0.25, force=(1.0, 0.0))
    scene = dataset.scene
    assert dataset.trajectory("train", 0).masses.tolist() == [2.0] * 4
    assert (scene.particle_spacing, scene.frame_dt, scene.force) == (0.5, 0.25, ConstantForce((1.0, 0.0)))
    assert scene.mass_source == "given: 2"


@pytest.mark.parametrize("members", [{}, {"velocity": np.ones((6, 4, 2), "f4"), "mass": np.arange(4.0)}])
@pytest.mark.parametrize("types", [(0, 0, 0, 0), (0, 1, 0, 2)])
def test_round_trip_is_exact(tmp_path, members, types):
    write_hdf5(tmp_path / "a", types=types, **members)
    first = open_dataset(tmp_path / "a")
    convert(first, tmp_path / "b")
    second = open_dataset(tmp_path / "b")
    assert second.scene == first.scene
    for split in SPLITS:
        assert len(second.splits[split]) == len(first.splits[split])
        assert_same_trajectory(second.trajectory(split, 0), first.trajectory(split, 0))


def test_records_convert_with_everything_that_was_given(tmp_path):
    for name in ("s1", "s2", "s3", "s4"):
        write_parts(tmp_path / "a", name=name, frames=record_frames(seed=ord(name[1])))
    first = open_dataset(tmp_path / "a", force=(0.0, -9.81, 0.0), mass=0.1)
    convert(first, tmp_path / "b")
    second = open_dataset(tmp_path / "b")
    assert second.scene == first.scene
    for split in SPLITS:
        for k in range(len(first.splits[split])):
            assert_same_trajectory(second.trajectory(split, k), first.trajectory(split, k))


def test_time_blocks_convert_to_trajectories_of_their_own(tmp_path):
    write_parts(tmp_path / "a")
    first = open_dataset(tmp_path / "a")
    convert(first, tmp_path / "b")
    second = open_dataset(tmp_path / "b")
    for split in SPLITS:
        assert_same_trajectory(second.trajectory(split, 0), first.trajectory(split, 0))


def test_converting_a_set_onto_itself_keeps_it(tmp_path):
    write_hdf5(tmp_path / "a")
    before = open_dataset(tmp_path / "a").trajectory("test", 0)
    convert(open_dataset(tmp_path / "a"), tmp_path / "a", overwrite=True)
    assert_same_trajectory(open_dataset(tmp_path / "a").trajectory("test", 0), before)


def test_set_without_extras_has_nothing_that_lagrangebench_does_not_know(tmp_path):
    write_hdf5(tmp_path / "a")
    convert(open_dataset(tmp_path / "a"), tmp_path / "b")
    with h5py.File(tmp_path / "b" / "train.h5") as file:
        assert sorted(file["00000"]) == ["particle_type", "position"]
        assert file["00000/position"].dtype == np.float32
        assert file["00000/position"].compression == "gzip"


def test_metadata_is_complete_and_its_statistics_are_per_frame(tmp_path):
    write_hdf5(tmp_path / "a", types=(0, 0, 0, 1))
    convert(open_dataset(tmp_path / "a"), tmp_path / "b")
    metadata = json.loads((tmp_path / "b" / "metadata.json").read_text())
    published = {"case", "solver", "density_evolution", "dim", "dx", "dt", "t_end", "viscosity", "p_bg_factor"}
    published |= {"g_ext_magnitude", "artificial_alpha", "free_slip", "write_every", "is_bc_trick", "bounds"}
    published |= {"sequence_length_train", "num_trajs_train", "sequence_length_test", "num_trajs_test"}
    published |= {"num_particles_max", "periodic_boundary_conditions", "default_connectivity_radius"}
    published |= {"vel_mean", "vel_std", "acc_mean", "acc_std"}
    assert published <= set(metadata)
    assert metadata["dt"] == METADATA["dt"]
    assert metadata["write_every"] == METADATA["write_every"]
    assert metadata["solver"] == "SPH"
    assert metadata["sequence_length_train"] == 5
    assert metadata["num_particles_max"] == 4
    assert metadata["default_connectivity_radius"] == 0.14
    positions = np.stack([stored(tmp_path / "a", "position", split)[:, :3] for split in SPLITS]).astype("f8")
    steps = np.diff(positions, axis=1)
    steps -= np.round(steps / [1.0, 2.0]) * [1.0, 2.0]
    accelerations = np.diff(steps, axis=1)
    every_particle = (0, 1, 2)
    assert metadata["vel_mean"] == pytest.approx(steps.mean(axis=every_particle).tolist())
    assert metadata["vel_std"] == pytest.approx(steps.std(axis=every_particle).tolist())
    assert metadata["acc_std"] == pytest.approx(accelerations.std(axis=every_particle).tolist(), abs=1e-9)


def test_statistics_of_a_single_frame_are_zero(tmp_path):
    write_hdf5(tmp_path / "a", num_frames=1)
    convert(open_dataset(tmp_path / "a"), tmp_path / "b")
    metadata = json.loads((tmp_path / "b" / "metadata.json").read_text())
    assert metadata["vel_std"] == [0.0, 0.0]
    assert metadata["acc_std"] == [0.0, 0.0]


@pytest.mark.parametrize(
    ("damage", "words"),
    [
        (lambda folder: (folder / "metadata.json").unlink(), ["metadata.json is missing"]),
        (lambda folder: (folder / "valid.h5").unlink(), ["valid.h5 is missing", "train.h5"]),
        (lambda folder: (folder / "metadata.json").write_text("{"), ["metadata.json", "not valid JSON", "correct"]),
        (lambda folder: (folder / "metadata.json").write_text("[1]"), ["metadata.json", "JSON object"]),
        (lambda folder: (folder / "train.h5").write_bytes(b""), ["train.h5", "is empty", "copy"]),
        (lambda folder: (folder / "train.h5").write_bytes(b"text"), ["train.h5", "truncated or not HDF5", "copy"]),
        (lambda folder: truncate(folder / "train.h5"), ["train.h5", "truncated", "copy"]),
        (lambda folder: h5py.File(folder / "test.h5", "w").close(), ["test.h5", "no trajectory", "00000"]),
        (lambda folder: change(folder, "position", None), ["train.h5", "train/00000", "`position` is missing"]),
        (lambda folder: change(folder, "particle_type", None), ["train.h5", "`particle_type` is missing"]),
        (lambda folder: change(folder, "position", np.zeros((6, 4, 3), "f4")), ["train.h5", "`position`", "dim 2"]),
        (lambda folder: change(folder, "position", np.zeros((6, 4, 2), int)), ["train.h5", "`position`", "int64"]),
        (lambda folder: change(folder, "position", np.zeros((0, 4, 2), "f4")), ["train.h5", "`position`", "(0, 4, 2)"]),
        (lambda folder: change(folder, "particle_type", np.zeros(3, int)), ["`particle_type`", "(4)", "(3,)"]),
        (lambda folder: change(folder, "velocity", np.zeros((5, 4, 2), "f4")), ["`velocity`", "shape of `position`"]),
        (lambda folder: change(folder, "mass", np.zeros((4, 1), "f4")), ["`mass`", "(4)", "(4, 1)"]),
        (lambda folder: change(folder, "position", nan_from(3)), ["train.h5", "train/00000", "frame 3", "`position`"]),
    ],
)
def test_damage_is_named_with_file_key_and_remedy(tmp_path, damage, words):
    write_hdf5(tmp_path)
    damage(tmp_path)
    with pytest.raises(DataError) as caught:
        open_dataset(tmp_path).trajectory("train", 0)
    message = str(caught.value)
    assert [word for word in words if word not in message] == []
    assert "\n" not in message


def truncate(file):
    file.write_bytes(file.read_bytes()[:-400])


def change(folder, key, values):
    with h5py.File(folder / "train.h5", "a") as file:
        if key in file["00000"]:
            del file["00000"][key]
        if values is not None:
            file["00000"][key] = values


def nan_from(frame):
    positions = np.zeros((6, 4, 2), "f4")
    positions[frame:] = np.nan
    return positions


def test_frames_are_one_time_step_apart_where_nothing_says_how_many(tmp_path):
    write_hdf5(tmp_path)
    (tmp_path / "metadata.json").write_text(json.dumps({k: v for k, v in METADATA.items() if k != "write_every"}))
    scene = open_dataset(tmp_path).scene
    assert scene.frame_dt == METADATA["dt"]
    assert any(line.startswith("frame dt: `write_every` is not stored") for line in scene.missing)


@pytest.mark.parametrize("key", ["dim", "dx", "dt", "bounds", "periodic_boundary_conditions"])
def test_missing_metadata_key_is_named(tmp_path, key):
    write_hdf5(tmp_path)
    (tmp_path / "metadata.json").write_text(json.dumps({k: v for k, v in METADATA.items() if k != key}))
    with pytest.raises(DataError, match=f"metadata.json: key `{key}` is missing; add it"):
        open_dataset(tmp_path)


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("dim", 4),
        ("dx", -0.1),
        ("dx", "0.1"),
        ("dt", float("nan")),
        ("bounds", [[0, 1]]),
        ("bounds", [[0, 1], [1, 1]]),
        ("periodic_boundary_conditions", [True]),
        ("cconv", {"force": [1.0]}),
        ("cconv", {"missing": "text"}),
    ],
)
def test_metadata_value_that_cannot_be_is_named(tmp_path, key, value):
    write_hdf5(tmp_path, {key: value})
    with pytest.raises(DataError, match=f"metadata.json: `{key}"):
        open_dataset(tmp_path)


def test_failed_writing_leaves_nothing(tmp_path):
    write_hdf5(tmp_path / "a")
    dataset = open_dataset(tmp_path / "a")
    change(tmp_path / "a", "position", nan_from(3))
    with pytest.raises(DataError):
        convert(dataset, tmp_path / "b")
    with pytest.raises(DataError, match="'valid' has no trajectory"):
        write_splits(tmp_path / "c", dataset.scene, {"train": [dataset.trajectory("test", 0)]})
    assert sorted(entry.name for entry in tmp_path.iterdir()) == ["a"]


def test_failed_overwriting_keeps_the_old_set(tmp_path):
    write_hdf5(tmp_path / "a")
    write_hdf5(tmp_path / "b")
    before = open_dataset(tmp_path / "b").fingerprint()
    change(tmp_path / "a", "position", nan_from(3))
    with pytest.raises(DataError):
        convert(open_dataset(tmp_path / "a"), tmp_path / "b", overwrite=True)
    assert open_dataset(tmp_path / "b").fingerprint() == before
    assert sorted(entry.name for entry in tmp_path.iterdir()) == ["a", "b"]


def test_existing_folders_are_kept_unless_overwritten(tmp_path):
    write_hdf5(tmp_path / "a")
    dataset = open_dataset(tmp_path / "a")
    convert(dataset, tmp_path / "b")
    with pytest.raises(ConfigError, match="not empty.*overwrite"):
        convert(dataset, tmp_path / "b")
    convert(dataset, tmp_path / "b", overwrite=True)
    (tmp_path / "b" / "thesis.tex").write_text("precious")
    with pytest.raises(ConfigError, match=r"thesis\.tex"):
        convert(dataset, tmp_path / "b", overwrite=True)
    with pytest.raises(ConfigError, match="is a file"):
        convert(dataset, tmp_path / "b" / "thesis.tex", overwrite=True)
    assert (tmp_path / "b" / "thesis.tex").read_text() == "precious"
