"""Folders that grow frame by frame hold what a folder written at once holds, as far as they came."""

import json
from dataclasses import replace

import pytest
import torch
from systems import periodic_scene, periodic_trajectory

from cconv.data import stored_frames
from cconv.data.dataset import open_dataset
from cconv.data.growing import growing_dataset
from cconv.data.hdf5 import write_splits
from cconv.data.metadata import DIFFERENCES
from cconv.data.stored_frames import StoredFrames
from cconv.data.trajectory import Trajectory
from cconv.errors import ConfigError

SCENE = replace(periodic_scene(), velocity_source=DIFFERENCES)
SPLITS = ("train", "valid", "test")


@pytest.fixture
def path(generator):
    """A trajectory of nine frames."""
    return periodic_trajectory(generator, 9)


def part(trajectory: Trajectory, stop: int) -> Trajectory:
    """The first frames of a trajectory."""
    return replace(trajectory, positions=trajectory.positions[:stop], velocities=trajectory.velocities[:stop])


def grow(folder, trajectory, frames):
    """Write the first three frames of a trajectory, then some of the others one by one."""
    with growing_dataset(folder, SCENE, part(trajectory, 3), {"solver": "SPH"}) as growing:
        for frame in frames:
            growing.append(dict.fromkeys(SPLITS, frame))


def assert_same_data(folder, other):
    ours, theirs = open_dataset(folder), open_dataset(other)
    assert ours.scene == theirs.scene
    for split in SPLITS:
        one, two = ours.trajectory(split, 0), theirs.trajectory(split, 0)
        for name in ("positions", "velocities", "masses", "particle_types"):
            assert torch.equal(getattr(one, name), getattr(two, name))
    statistics = {f"{name}_{what}" for name in ("vel", "acc") for what in ("mean", "std")}
    for key in ours.metadata.keys() | theirs.metadata.keys():
        expected = theirs.metadata[key]
        assert ours.metadata[key] == (pytest.approx(expected) if key in statistics else expected), key


@pytest.mark.parametrize("piece", [2, 64])
def test_what_grew_is_what_is_written_at_once(piece, path, tmp_path, monkeypatch):
    monkeypatch.setattr("cconv.data.growing.FRAMES_OF_A_PIECE", piece)
    grow(tmp_path / "grown", path, path.positions[3:])
    write_splits(tmp_path / "whole", SCENE, {split: [path] for split in SPLITS}, {"solver": "SPH"})
    assert_same_data(tmp_path / "grown", tmp_path / "whole")


@pytest.mark.parametrize("kind", [KeyboardInterrupt, ValueError])
def test_what_ends_the_block_keeps_the_frames_so_far(kind, path, tmp_path):
    def frames():
        yield from path.positions[3:5]
        raise kind

    with pytest.raises(kind):
        grow(tmp_path / "grown", path, frames())
    write_splits(tmp_path / "whole", SCENE, {split: [part(path, 5)] for split in SPLITS}, {"solver": "SPH"})
    assert_same_data(tmp_path / "grown", tmp_path / "whole")
    assert {each.name for each in tmp_path.iterdir()} == {"grown", "whole"}


def test_a_frame_that_not_every_split_has_is_dropped(path, tmp_path):
    folder = growing_dataset(tmp_path / "grown", SCENE, part(path, 3), {})
    with pytest.raises(KeyError), folder as growing:  # noqa: PT012
        growing.append(dict.fromkeys(SPLITS, path.positions[3]))
        growing.append({"train": path.positions[4]})
    assert {len(open_dataset(tmp_path / "grown").trajectory(split, 0)) for split in SPLITS} == {4}


def test_what_ends_before_a_frame_leaves_nothing(path, tmp_path):
    with pytest.raises(KeyboardInterrupt), growing_dataset(tmp_path / "grown", SCENE, part(path, 3), {}):
        raise KeyboardInterrupt
    assert list(tmp_path.iterdir()) == []


def test_a_folder_that_holds_something_is_refused(path, tmp_path):
    (tmp_path / "metadata.json").write_text(json.dumps({}))
    with pytest.raises(ConfigError, match="exists and is not empty"):
        grow(tmp_path, path, [])


@pytest.mark.parametrize("piece", [1, 2, 64])
def test_frames_that_are_read_in_pieces_are_those_of_the_trajectory(piece, path, tmp_path, monkeypatch):
    monkeypatch.setattr(stored_frames, "FRAMES_OF_A_PIECE", piece)
    write_splits(tmp_path, SCENE, {split: [path] for split in SPLITS})
    dataset = open_dataset(tmp_path)
    whole, frames = dataset.trajectory("test", 0), StoredFrames(dataset, "test", 0)
    assert (len(frames), frames.name, frames.first_frame) == (len(whole), whole.name, 0)
    for place in (0, 8, 3, 4, 7):
        for name in ("positions", "velocities", "masses", "particle_types"):
            assert torch.equal(getattr(frames[place], name), getattr(whole[place], name))
    assert torch.equal(frames.between(2, 5).positions, whole.positions[2:5])
    with pytest.raises(IndexError):
        frames[9]
