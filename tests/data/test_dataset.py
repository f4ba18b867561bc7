import shutil

import pytest
import torch
from particle_files import record_frames, write_hdf5, write_parts

from cconv.data.dataset import open_dataset
from cconv.errors import ConfigError, DataError


def write_simulations(folder, count):
    for index in range(count):
        write_parts(folder, name=f"sim_{index:04d}", frames=record_frames(seed=index))


def test_single_trajectory_is_cut_in_time(tmp_path):
    write_parts(tmp_path)
    dataset = open_dataset(tmp_path, gap=1)
    frames = {}
    for split in ("train", "valid", "test"):
        trajectory = dataset.trajectory(split, 0)
        frames[split] = {trajectory.first_frame + index for index in range(len(trajectory))}
    assert min(frames["valid"]) - max(frames["train"]) == 2
    assert min(frames["test"]) - max(frames["valid"]) == 2
    assert max(frames["test"]) == 11


def test_several_trajectories_are_split_whole_by_a_seed(tmp_path):
    write_simulations(tmp_path, 8)
    splits = open_dataset(tmp_path).splits
    names = [block.trajectory for blocks in splits.values() for block in blocks]
    assert sorted(names) == [f"sim_{index:04d}" for index in range(8)]
    assert all((block.start, block.stop) == (0, None) for blocks in splits.values() for block in blocks)
    assert open_dataset(tmp_path).splits == splits
    assert any(open_dataset(tmp_path, data_seed=seed).splits != splits for seed in range(1, 5))


def test_stored_splits_are_kept(tmp_path):
    write_hdf5(tmp_path)
    dataset = open_dataset(tmp_path, data_seed=3, split_fractions=(0.2, 0.4, 0.4))
    assert {split: [block.trajectory for block in blocks] for split, blocks in dataset.splits.items()} == {
        split: [f"{split}/00000"] for split in ("train", "valid", "test")
    }


def test_frames_go_through_every_block(tmp_path):
    write_simulations(tmp_path, 4)
    dataset = open_dataset(tmp_path)
    assert len(dataset.splits["train"]) == 2
    frames = list(dataset.frames("train"))
    assert len(frames) == 24 == sum(dataset.num_frames(block) for block in dataset.splits["train"])
    trajectory, index = frames[13]
    assert torch.equal(trajectory[index].positions, dataset.trajectory("train", 1).positions[1])


def test_too_few_trajectories_or_frames_to_split(tmp_path):
    write_simulations(tmp_path / "two", 2)
    with pytest.raises(DataError, match="2 trajectories, too few for 3 splits"):
        open_dataset(tmp_path / "two")
    write_parts(tmp_path / "short", frames=record_frames(num_frames=6))
    with pytest.raises(DataError, match="6 frames, too few .* at least 7"):
        open_dataset(tmp_path / "short")
    assert open_dataset(tmp_path / "short", gap=1).splits["test"][0].stop == 6


def test_fingerprint_tells_data_apart_but_not_places(tmp_path):
    write_parts(tmp_path / "a")
    shutil.copytree(tmp_path / "a", tmp_path / "b")
    write_parts(tmp_path / "c", frames=record_frames(seed=1))
    first, copied, other = (open_dataset(tmp_path / name).fingerprint() for name in "abc")
    assert first == copied != other
    (tmp_path / "b" / "sim_00.msgpack.zst").rename(tmp_path / "b" / "sim_000.msgpack.zst")
    assert open_dataset(tmp_path / "b").fingerprint() != first


def test_missing_folder_and_folder_without_data(tmp_path):
    with pytest.raises(DataError, match="does not exist"):
        open_dataset(tmp_path / "nowhere")
    with pytest.raises(DataError, match=r"looked for train\.h5.*msgpack\.zst"):
        open_dataset(tmp_path)
    (tmp_path / "file").write_text("")
    with pytest.raises(DataError, match="is a file; name the folder"):
        open_dataset(tmp_path / "file")


def test_unknown_split_and_block_are_named(tmp_path):
    write_hdf5(tmp_path)
    dataset = open_dataset(tmp_path)
    with pytest.raises(DataError, match=r"no split 'validation'.*train, valid, test.*Did you mean 'valid'"):
        dataset.trajectory("validation", 0)
    with pytest.raises(DataError, match="'train' has 1 trajectories.*got 1"):
        dataset.trajectory("train", 1)


@pytest.mark.parametrize(
    ("settings", "name"),
    [
        ({"mass": 0.0}, "mass"),
        ({"mass": float("nan")}, "mass"),
        ({"particle_spacing": -1.0}, "particle_spacing"),
        ({"frame_dt": float("inf")}, "frame_dt"),
        ({"force": (0.0, -9.81)}, "force"),
        ({"force": (0.0, float("nan"), 0.0)}, "force"),
        ({"split_fractions": (0.5, 0.5)}, "split_fractions"),
        ({"split_fractions": (0.5, 0.5, 0.5)}, "split_fractions"),
        ({"split_fractions": (1.0, 0.0, 0.0)}, "split_fractions"),
        ({"gap": -1}, "gap"),
    ],
)
def test_settings_that_cannot_be_are_named(tmp_path, settings, name):
    write_parts(tmp_path)
    with pytest.raises(ConfigError, match=f"`{name}`"):
        open_dataset(tmp_path, **settings)
