import pickle

import msgpack
import numpy as np
import pytest
import torch
from particle_files import FRAME_DT, encode, record_frames, walls, write_packed, write_parts, write_records

from cconv.data.dataset import open_dataset
from cconv.data.deep_lagrangian_fluids import decode_array
from cconv.errors import DataError
from cconv.forces import ConstantForce


def read_all(folder, **given):
    dataset = open_dataset(folder, **given)
    return dataset, dataset.source.read(dataset.source.names[0])


def test_frames_of_all_parts_come_in_order(tmp_path):
    frames = record_frames()
    write_parts(tmp_path, frames=frames)
    _, trajectory = read_all(tmp_path)
    torch.testing.assert_close(
        trajectory.positions.numpy(), np.stack([frame["pos"] for frame in frames]), rtol=0, atol=0
    )
    torch.testing.assert_close(
        trajectory.velocities.numpy(), np.stack([frame["vel"] for frame in frames]), rtol=0, atol=0
    )
    assert trajectory.positions.dtype == torch.float32
    assert trajectory.first_frame == 0
    assert trajectory.name == "sim"


def test_parts_are_ordered_by_number_not_by_text(tmp_path):
    frames = record_frames(num_frames=11)
    for part, frame in enumerate(frames):
        write_records(tmp_path / f"a_{part}.msgpack.zst", [frame])
    _, trajectory = read_all(tmp_path)
    assert np.array_equal(trajectory.positions.numpy()[-1], frames[-1]["pos"])


@pytest.mark.parametrize(("start", "stop"), [(0, 3), (4, 6), (3, 12), (5, 10), (11, None)])
def test_block_reads_the_same_frames_and_only_its_files(tmp_path, start, stop):
    frames = record_frames()
    write_parts(tmp_path, frames=frames)
    source = open_dataset(tmp_path).source
    for part, file in enumerate(source.files):
        if part * 5 >= (stop or 12) or (part + 1) * 5 <= start:
            packed_head_only = msgpack.packb([0] * min(5, 12 - part * 5))
            write_packed(file, packed_head_only)
    block = source.read("sim", start, stop)
    assert np.array_equal(block.positions.numpy(), np.stack([frame["pos"] for frame in frames[start:stop]]))
    assert block.first_frame == start


def test_boundary_and_box_are_the_wall_points(tmp_path):
    write_parts(tmp_path)
    dataset, trajectory = read_all(tmp_path)
    points, normals = walls()
    assert np.array_equal(trajectory.boundary.positions.numpy(), points)
    assert np.array_equal(trajectory.boundary.normals.numpy(), normals)
    assert dataset.scene.has_boundary
    assert dataset.scene.box.lower == (0.0, 0.0, 0.0)
    assert dataset.scene.box.upper == (1.0, 1.0, 1.0)
    assert dataset.scene.box.periodic == (False, False, False)


def test_without_wall_points_the_box_holds_the_particles(tmp_path):
    frames = record_frames()
    write_parts(tmp_path, frames=frames, with_walls=False)
    dataset, trajectory = read_all(tmp_path)
    assert trajectory.boundary is None
    assert not dataset.scene.has_boundary
    assert dataset.scene.box.lower == tuple(frames[0]["pos"].min(axis=0).tolist())
    assert any(line.startswith("boundary:") for line in dataset.scene.missing)


def test_walls_in_a_plane_give_a_box_of_one_spacing(tmp_path):
    frames = record_frames()
    frames[0]["box"] = np.array([[0, 0.5, 0], [1, 0.5, 0], [0, 0.5, 1]], "f4")
    write_records(tmp_path / "a_0.msgpack.zst", frames, with_walls=False)
    assert open_dataset(tmp_path).scene.box.lengths[1] == pytest.approx(0.05)


def test_zero_masses_are_replaced_and_said_so(tmp_path):
    write_parts(tmp_path)
    dataset, trajectory = read_all(tmp_path)
    assert trajectory.masses.tolist() == [0.125] * 5
    assert "0.125" in dataset.scene.mass_source
    assert any(line.startswith("masses:") for line in dataset.scene.missing)


def test_replaced_masses_follow_the_spacing(tmp_path):
    write_parts(tmp_path)
    _, trajectory = read_all(tmp_path, particle_spacing=0.1)
    assert trajectory.masses.tolist() == pytest.approx([1.0] * 5)


def test_stored_masses_are_kept(tmp_path):
    write_parts(tmp_path, frames=record_frames(mass=0.25))
    dataset, trajectory = read_all(tmp_path)
    assert trajectory.masses.tolist() == [0.25] * 5
    assert dataset.scene.mass_source == "stored"
    assert not any(line.startswith("masses:") for line in dataset.scene.missing)


def test_what_is_given_wins_and_is_no_longer_missing(tmp_path):
    write_parts(tmp_path, frames=record_frames(mass=0.25))
    dataset, trajectory = read_all(tmp_path, mass=0.5, particle_spacing=0.1, frame_dt=0.5, force=(0.0, -9.81, 0.0))
    assert trajectory.masses.tolist() == [0.5] * 5
    assert dataset.scene.particle_spacing == 0.1
    assert dataset.scene.frame_dt == 0.5
    assert dataset.scene.force == ConstantForce((0.0, -9.81, 0.0))
    assert dataset.scene.missing == ()


def test_time_between_frames_is_fitted_to_the_velocities_that_moved_the_particles(tmp_path):
    write_parts(tmp_path)
    scene = open_dataset(tmp_path).scene
    assert scene.frame_dt == pytest.approx(FRAME_DT, rel=1e-5)
    assert any(line.startswith("frame dt:") for line in scene.missing)


def test_time_between_frames_that_cannot_be_fitted_must_be_given(tmp_path):
    frames = record_frames()
    write_parts(tmp_path, frames=[{**frame, "vel": 0 * frame["vel"]} for frame in frames])
    with pytest.raises(DataError, match="frame_dt"):
        open_dataset(tmp_path)
    assert open_dataset(tmp_path, frame_dt=0.1).scene.frame_dt == 0.1


def test_viscosities_are_read_and_zero_ones_are_none(tmp_path):
    write_parts(tmp_path / "some")
    write_parts(tmp_path / "zero", frames=[{**f, "viscosity": 0 * f["viscosity"]} for f in record_frames()])
    assert read_all(tmp_path / "some")[1].viscosities.tolist() == pytest.approx([0.01] * 5)
    assert read_all(tmp_path / "zero")[1].viscosities is None


def test_big_endian_and_double_precision_arrays_are_read(tmp_path):
    frames = record_frames()
    write_records(tmp_path / "a_0.msgpack.zst", [{**f, "pos": f["pos"].astype(">f8")} for f in frames])
    _, trajectory = read_all(tmp_path)
    assert trajectory.positions.dtype == torch.float64
    assert np.array_equal(trajectory.positions.numpy()[3], frames[3]["pos"])


@pytest.mark.parametrize("value", [np.arange(6.0).reshape(2, 3), np.float32(2.5), np.int64(-3), np.zeros((0, 3), "f4")])
def test_decoding_inverts_encoding(value):
    decoded = decode_array(encode(value))
    assert np.array_equal(decoded, value)
    assert np.asarray(decoded).dtype == np.asarray(value).dtype


class Attack:
    """What a pickle that runs code looks like."""

    def __reduce__(self):
        return (pytest.fail, ("code found in data was run",))


@pytest.mark.parametrize("dtype", ["|O", "O", "<M8[s]", "|V8", b"<f4", None, [["a", "<f4"]]])
def test_arrays_that_could_run_code_are_refused(tmp_path, dtype):
    frame = record_frames(num_frames=1)[0]
    record = {b"nd": True, b"type": dtype, b"kind": b"O", b"shape": [1], b"data": pickle.dumps(Attack())}
    encoded = {key: encode(value) for key, value in frame.items() if key != "pos"} | {"pos": record}
    write_packed(tmp_path / "a_0.msgpack.zst", msgpack.packb([encoded]))
    with pytest.raises(DataError, match=r"a_0\.msgpack\.zst: an array has dtype"):
        open_dataset(tmp_path)


def damaged(frames, index, **changes):
    frames = [dict(frame) for frame in frames]
    frames[index] = {key: value for key, value in {**frames[index], **changes}.items() if value is not None}
    return frames


def nan_at(array):
    array = array.copy()
    array[0, 0] = np.nan
    return array


FRAMES = record_frames()


@pytest.mark.parametrize(
    ("frames", "words"),
    [
        (damaged(FRAMES, 7, pos=nan_at(FRAMES[7]["pos"])), ["a_01.msgpack.zst", "frame 7", "`pos`", "NaN", "cut"]),
        (damaged(FRAMES, 7, vel=nan_at(FRAMES[7]["vel"])), ["a_01.msgpack.zst", "frame 7", "`vel`", "NaN"]),
        (damaged(FRAMES, 3, pos=FRAMES[3]["pos"][:4]), ["a_00.msgpack.zst", "frame 3", "(5, 3) to (4, 3)", "must not"]),
        (damaged(FRAMES, 3, vel=None), ["a_00.msgpack.zst", "`vel` is missing", "pos, m"]),
        (damaged(FRAMES, 0, m=None), ["a_00.msgpack.zst", "`m` is missing"]),
        (damaged(FRAMES, 0, m=FRAMES[0]["m"][:2]), ["`m`", "shape (5)", "(2,)"]),
        (damaged(FRAMES, 2, pos=FRAMES[2]["pos"][0]), ["frame 2", "`pos`", "(particles, dim)"]),
        (damaged(FRAMES, 2, pos="text"), ["frame 2", "`pos`", "str"]),
        ([{**frame, "vel": frame["vel"][:, :2]} for frame in FRAMES], ["`vel`", "shape of `pos`"]),
        (FRAMES[:3] + FRAMES[4:], ["a_00.msgpack.zst", "`frame_id` jumps from 2 to 4", "add the missing file"]),
        (FRAMES[:5] + FRAMES[6:], ["a_01.msgpack.zst", "`frame_id` jumps from 4 to 6"]),
    ],
)
def test_bad_frames_are_named_with_file_key_and_remedy(tmp_path, frames, words):
    write_parts(tmp_path, name="a", frames=frames)
    with pytest.raises(DataError) as caught:
        read_all(tmp_path)
    message = str(caught.value)
    assert [word for word in words if word not in message] == []
    assert "\n" not in message


def test_empty_truncated_and_foreign_files_are_named(tmp_path):
    write_parts(tmp_path, name="a")
    file = tmp_path / "a_01.msgpack.zst"
    whole = file.read_bytes()
    for content, word in [
        (b"", "is empty"),
        (whole[: len(whole) // 2], "truncated"),
        (b"not compressed at all", "truncated or not zstd"),
    ]:
        file.write_bytes(content)
        with pytest.raises(DataError, match=rf"a_01\.msgpack\.zst: .*{word}.*copy it again"):
            read_all(tmp_path)


@pytest.mark.parametrize("content", [{"pos": 1}, [], [1, 2]])
def test_files_without_frames_are_refused(tmp_path, content):
    write_packed(tmp_path / "a_00.msgpack.zst", msgpack.packb(content))
    with pytest.raises(DataError, match=r"a_00\.msgpack\.zst"):
        open_dataset(tmp_path)


def test_walls_that_change_between_files_are_refused(tmp_path):
    write_parts(tmp_path, name="a")
    frames = record_frames()[5:10]
    frames[0]["box"], frames[0]["box_normals"] = walls(3)
    write_records(tmp_path / "a_01.msgpack.zst", frames, with_walls=False)
    with pytest.raises(DataError, match="`box` differs"):
        read_all(tmp_path)


def test_sub_folders_are_the_splits(tmp_path):
    for split, names in {"train": ["s1", "s2"], "valid": ["s3"], "test": ["s1"]}.items():
        for name in names:
            write_parts(tmp_path / split, name=name)
    splits = open_dataset(tmp_path).splits
    assert [block.trajectory for block in splits["train"]] == ["train/s1", "train/s2"]
    assert [block.trajectory for block in splits["valid"]] == ["valid/s3"]
    assert [block.trajectory for block in splits["test"]] == ["test/s1"]


def test_without_a_test_folder_validation_gives_one(tmp_path):
    for split, names in {"train": ["s1"], "valid": ["s2", "s3", "s4"]}.items():
        for name in names:
            write_parts(tmp_path / split, name=name)
    dataset = open_dataset(tmp_path)
    valid, test = ({block.trajectory for block in dataset.splits[split]} for split in ("valid", "test"))
    assert valid | test == {"valid/s2", "valid/s3", "valid/s4"}
    assert not valid & test
    assert valid
    assert test
    assert any(line.startswith("test split:") for line in dataset.scene.missing)


def test_train_folder_without_valid_folder_is_refused(tmp_path):
    write_parts(tmp_path / "train")
    with pytest.raises(DataError, match="train but must have both train/ and valid/"):
        open_dataset(tmp_path)
