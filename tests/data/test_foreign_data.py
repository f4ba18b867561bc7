"""Data from strangers: what leaves the folder, was never written or takes too much is refused in one line."""

import json

import h5py
import numpy as np
import pytest
import zstandard
from outcomes import assert_one_clear_line
from particle_files import METADATA, write_hdf5, write_packed, write_parts

from cconv.data import deep_lagrangian_fluids
from cconv.data.dataset import open_dataset
from cconv.errors import ConfigError, DataError

SHAPE = (6, 4, 2)  # of `position` in the small files
WALLS = {"boundary_position": np.zeros((3, 2)), "boundary_normal": np.tile([0.0, 1.0], (3, 1))}


def read_all(folder):
    dataset = open_dataset(folder)
    return [trajectory for split in dataset.splits for trajectory in dataset.trajectories(split)]


def external_link(group, folder):
    group["position"] = h5py.ExternalLink("../secret.h5", "00000/position")


def soft_link_through_an_external_one(group, folder):
    group.file["other"] = h5py.ExternalLink("../secret.h5", "/")
    group["position"] = h5py.SoftLink("/other/00000/position")


def dangling_soft_link(group, folder):
    group["position"] = h5py.SoftLink("/nowhere")


def external_storage(group, folder):
    secret = folder.parent / "secret.bin"
    secret.write_bytes(bytes(4 * 48))
    group.create_dataset("position", SHAPE, "f4", external=[(str(secret), 0, h5py.h5f.UNLIMITED)])


def virtual(group, name):
    layout = h5py.VirtualLayout(SHAPE, "f4")
    layout[...] = h5py.VirtualSource(name, "00000/position", SHAPE)
    group.create_virtual_dataset("position", layout)


def half_virtual(group, folder):
    layout = h5py.VirtualLayout(SHAPE, "f4")
    layout[:3] = h5py.VirtualSource("valid.h5", "00000/position", SHAPE)[:3]
    group.create_virtual_dataset("position", layout)


def half_written(group, folder):
    group.create_dataset("position", SHAPE, "f4", chunks=(1, 4, 2))[:4] = 0.5


def with_missing_filter(group, folder):
    settings = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
    settings.set_chunk(SHAPE)
    settings.set_filter(32001, h5py.h5z.FLAG_OPTIONAL)
    space = h5py.h5s.create_simple(SHAPE)
    h5py.h5d.create(group.id, b"position", h5py.h5t.IEEE_F32LE, space, settings)


@pytest.mark.parametrize(
    ("store", "words"),
    [
        (external_link, "secret.h5.*not followed"),
        (soft_link_through_an_external_one, "secret.h5.*not followed"),
        (dangling_soft_link, "/nowhere.*leads nowhere"),
        (external_storage, "outside the file .*secret.bin"),
        (lambda group, folder: virtual(group, "../secret.h5"), "outside of its folder"),
        (lambda group, folder: virtual(group, "left_behind.h5"), "left_behind.h5, which is missing"),
        (half_virtual, "24 of its values have no source"),
        (half_written, "not written from frame 4 on"),
        (with_missing_filter, "filter 32001"),
        (lambda group, folder: group.create_dataset("position", SHAPE, "f4"), "never written"),
        (
            lambda group, folder: group.create_dataset("position", (10**6, 10**6, 2), "f4"),
            "8 TB but only 0 bytes",
        ),
        (lambda group, folder: group.create_dataset("position", (10**4, 4000, 2), "f4"), "320 MB but only"),
        (lambda group, folder: group.create_dataset("position", data=np.zeros(SHAPE, "g")), "float64"),
        (lambda group, folder: group.create_dataset("position", data=np.zeros(SHAPE, "c8")), "must be numbers"),
        (lambda group, folder: group.create_dataset("position", data=np.full(SHAPE, b"text")), "must be numbers"),
        (lambda group, folder: group.create_dataset("position", data=h5py.Empty("f4")), "array with values"),
    ],
)
def test_positions_that_must_not_be_read_are_refused(tmp_path, store, words):
    write_hdf5(tmp_path / "set")
    (tmp_path / "secret.h5").write_bytes((tmp_path / "set" / "valid.h5").read_bytes())
    with h5py.File(tmp_path / "set" / "train.h5", "r+", libver="latest") as file:
        del file["00000/position"]
        store(file["00000"], tmp_path / "set")
    with pytest.raises(DataError, match=words) as refusal:
        read_all(tmp_path / "set")
    assert "train.h5" in str(refusal.value)


@pytest.mark.parametrize("value", [np.nan, np.inf, -1e300, 1e13])
@pytest.mark.parametrize("key", ["position", "velocity", "mass", "viscosity", "boundary_position", "boundary_normal"])
def test_numbers_that_no_unit_makes_sense_of_are_refused(tmp_path, key, value):
    write_hdf5(tmp_path, velocity=np.ones(SHAPE), mass=np.ones(4), viscosity=np.ones(4), **WALLS)
    with h5py.File(tmp_path / "train.h5", "r+") as file:
        stored = file[f"00000/{key}"][()].astype("f8")
        stored.flat[0] = value
        del file[f"00000/{key}"]
        file[f"00000/{key}"] = stored
    with pytest.raises(DataError, match=f"`{key}` has a NaN or a value beyond 1e.12"):
        read_all(tmp_path)


def test_whole_numbers_are_read_as_floating_point(tmp_path):
    write_hdf5(tmp_path, velocity=np.ones(SHAPE, int), mass=np.ones(4, "u1"), viscosity=np.ones(4, int))
    for trajectory in read_all(tmp_path):
        assert all(
            values.is_floating_point() for values in (trajectory.velocities, trajectory.masses, trajectory.viscosities)
        )


def test_a_trajectory_in_another_file_is_refused(tmp_path):
    write_hdf5(tmp_path)
    with h5py.File(tmp_path / "train.h5", "w") as file:
        file["00000"] = h5py.ExternalLink("valid.h5", "00000")
    with pytest.raises(DataError, match="valid.h5.*not followed"):
        open_dataset(tmp_path)


def test_sources_in_the_folder_and_links_in_the_file_are_read(tmp_path):
    write_hdf5(tmp_path)
    with h5py.File(tmp_path / "train.h5", "r+", libver="latest") as file:
        del file["00000/position"]
        virtual(file["00000"], "valid.h5")
        file["00001"] = h5py.SoftLink("/00000")
    first, second, valid, _ = read_all(tmp_path)
    assert first.positions.equal(valid.positions)
    assert second.positions.equal(valid.positions)


def test_unknown_types_and_mere_walls_are_refused(tmp_path):
    write_hdf5(tmp_path / "unknown", types=(0, 0, 7, 7))
    with pytest.raises(DataError, match=r"unknown values 7 \(2 times\)"):
        open_dataset(tmp_path / "unknown")
    write_hdf5(tmp_path / "walls", types=(1, 1, 1))
    with pytest.raises(DataError, match="no particle is fluid"):
        open_dataset(tmp_path / "walls")


@pytest.mark.parametrize("value", [True, float("inf"), float("nan"), 1e300, 1e-300, 10**30, "0.1", None, [[]]])
@pytest.mark.parametrize("key", ["dim", "dx", "dt", "write_every"])
def test_numbers_of_metadata_have_a_range(tmp_path, key, value):
    write_hdf5(tmp_path, {key: value})
    with pytest.raises(DataError, match=f"metadata.json: `{key}` must be"):
        open_dataset(tmp_path)


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"[" * 100_000, "nested too deeply"),
        (b"\xff\xfe", "not valid JSON"),
        (b" " * 2**21, "at most"),
        (json.dumps(METADATA | {"dx": 7}).encode().replace(b"7", b"7" * 5000, 1), "not valid JSON"),
    ],
    ids=["deep", "not UTF-8", "large", "long number"],
)
def test_metadata_that_no_reader_should_parse_are_refused(tmp_path, content, words):
    write_hdf5(tmp_path)
    (tmp_path / "metadata.json").write_bytes(content)
    with pytest.raises(DataError, match=words):
        open_dataset(tmp_path)


@pytest.mark.parametrize("given", [{"mass": 1e300}, {"particle_spacing": 1e-300}, {"force": (0.0, 1e300)}])
def test_given_numbers_have_a_range(tmp_path, given):
    write_hdf5(tmp_path)
    with pytest.raises(ConfigError, match=next(iter(given))):
        open_dataset(tmp_path, **given)


def test_a_force_of_another_dimension_is_no_damage_of_the_file(tmp_path):
    write_hdf5(tmp_path)
    with pytest.raises(ConfigError, match=r"^`force` must have one number an axis \(2\), got 1\.$"):
        open_dataset(tmp_path, force=(0.0,))


def test_markup_and_control_characters_are_shown_as_they_are(cconv, tmp_path):
    mass = np.ones(4, "f4")
    own = {"name": "[/red]\x1b[2J" + "x" * 10_000, "missing": ["[/bold]"], "mass_source": "[link=evil]"}
    write_hdf5(tmp_path / "a", {"cconv": own}, mass=mass)
    status, out, _ = cconv("data", "inspect", tmp_path / "a")
    assert status == 0
    assert "[/red]?[2J" in out
    assert "[/bold]" in out
    assert "[link=evil]" in out
    assert "\x1b" not in out
    assert out.count("x") < 400


def test_decompression_is_bounded_by_memory(cconv, tmp_path, monkeypatch):
    monkeypatch.setattr(deep_lagrangian_fluids, "memory_limit", lambda: 3 * 2**20)
    write_packed(tmp_path / "a" / "sim_00.msgpack.zst", b"\x91" + bytes(2**26))
    assert_one_clear_line(cconv("data", "inspect", tmp_path / "a"), "sim_00.msgpack.zst", "decompresses to more")


def test_records_may_be_several_zstd_frames(tmp_path):
    write_parts(tmp_path / "one")
    write_parts(tmp_path / "many")
    for file in (tmp_path / "many").iterdir():
        packed = zstandard.ZstdDecompressor().decompress(file.read_bytes())
        middle, compress = len(packed) // 2, zstandard.ZstdCompressor().compress
        skippable = b"\x50\x2a\x4d\x18\x04\x00\x00\x00note"
        file.write_bytes(skippable + compress(packed[:middle]) + compress(packed[middle:]))
    for one, many in zip(read_all(tmp_path / "one"), read_all(tmp_path / "many"), strict=True):
        assert one.positions.equal(many.positions)
