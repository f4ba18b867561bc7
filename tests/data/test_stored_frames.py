"""Frames are read when they are asked for: what is opened and walked through never stands in memory whole."""

import pickle
from types import SimpleNamespace

import h5py
import numpy as np
import pytest
import torch
from outcomes import assert_one_clear_line
from systems import periodic_scene, periodic_trajectory

from cconv.data import stored_frames
from cconv.data.dataset import open_dataset
from cconv.data.hdf5 import write_splits
from cconv.data.inspect import inspect_dataset
from cconv.data.plausibility import dataset_findings
from cconv.data.stored_frames import StoredFrames, kept_trajectories
from cconv.errors import DataError
from cconv.tasks import task_named
from cconv.tasks.samples import FrameSamples, learned_samples

FRAMES = 40


@pytest.fixture
def folder(generator, tmp_path):
    """A data set of one trajectory a split."""
    splits = {split: [periodic_trajectory(generator, FRAMES)] for split in ("train", "valid", "test")}
    write_splits(tmp_path / "data", periodic_scene(), splits)
    return tmp_path / "data"


@pytest.fixture
def frames_read(monkeypatch):
    """Numbers of frames that are read of positions and velocities, one after another."""
    read, usual = [], h5py.Dataset.__getitem__

    def counting(dataset, frames, *more):
        found = usual(dataset, frames, *more)
        if dataset.name.endswith(("position", "velocity")) and isinstance(frames, slice):
            read.append(len(found))
        return found

    monkeypatch.setattr(h5py.Dataset, "__getitem__", counting)
    return read


@pytest.fixture
def small_pieces(monkeypatch):
    """Let a piece have three frames."""
    frame = 2 * 4 * 2 * 64  # positions and velocities of 64 particles in 2D, float32
    monkeypatch.setattr(stored_frames, "PIECE_BYTES", 3 * frame + 1)


def test_opening_reads_no_frame_and_walking_only_what_is_asked(folder, frames_read, small_pieces):
    dataset = open_dataset(folder)
    assert frames_read == []
    stored = StoredFrames(dataset, "train", 0)
    assert len(stored) == FRAMES
    assert max(frames_read) == 1  # the first frame tells how large one is
    frames_read.clear()
    stored[20]
    assert sum(frames_read) <= 2 * 5  # a piece, and a frame more at each end, of positions and of velocities
    frames_read.clear()
    assert sum(1 for _ in stored) == FRAMES
    assert max(frames_read) <= 5


def test_pieces_have_the_frames_of_the_whole(folder, small_pieces):
    dataset = open_dataset(folder)
    whole, stored = dataset.trajectory("train", 0), StoredFrames(dataset, "train", 0)
    for index in (0, 1, 2, 3, 17, FRAMES - 1, 4):
        assert torch.equal(stored[index].positions, whole[index].positions)
        assert torch.equal(stored[index].velocities, whole[index].velocities)
    again = pickle.loads(pickle.dumps(stored))
    assert torch.equal(again[5].positions, whole[5].positions)
    pieces = list(stored.pieces())
    assert [piece.first_frame for piece in pieces] == list(range(0, FRAMES, 3))
    assert all(
        torch.equal(one.positions[-1], two.positions[0]) for one, two in zip(pieces[:-1], pieces[1:], strict=True)
    )


def test_findings_and_facts_do_not_depend_on_the_pieces(folder, frames_read, monkeypatch):
    dataset = open_dataset(folder)
    findings, facts = dataset_findings(dataset), inspect_dataset(dataset)
    monkeypatch.setattr(stored_frames, "PIECE_BYTES", 1)
    frames_read.clear()
    again = inspect_dataset(dataset)
    assert max(frames_read) <= 2
    assert [each.check for each in dataset_findings(dataset)] == [each.check for each in findings]
    assert again["splits"] == facts["splits"]
    assert again["speed"]["max"] == facts["speed"]["max"]


def test_samples_beyond_the_memory_are_made_when_they_are_asked_for(folder, frames_read, small_pieces):
    dataset, task = open_dataset(folder), task_named("density_rate")
    kept = FrameSamples(dataset, "train", task)
    frames_read.clear()
    few = FrameSamples(dataset, "train", task, most_bytes=kept[0].nbytes + 1)
    assert sum(frames_read) <= 2 * 5 + 4  # two samples
    for index in (0, 1, 7, FRAMES - 1):
        assert torch.equal(few[index].target, kept[index].target)
        assert few[index].frame == index
    assert [sample.frame for sample in few[5:8]] == [5, 6, 7]


def test_windows_beyond_the_memory_are_read_when_they_are_asked_for(folder, monkeypatch):
    dataset, task = open_dataset(folder), task_named("acceleration")
    kept = learned_samples(dataset, "train", task)
    assert [type(each).__name__ for each in kept_trajectories(dataset, "train", 10)] == ["StoredFrames"]
    monkeypatch.setattr("cconv.tasks.samples.kept_trajectories", lambda *given: kept_trajectories(*given, 10))
    read = learned_samples(dataset, "train", task)
    assert len(read) == len(kept)
    for index in (0, 9, len(kept) - 1):
        assert torch.equal(read.window(index).positions, kept.window(index).positions)
        assert torch.equal(read.window(index).future, kept.window(index).future)
        assert read.window(index).frame == kept.window(index).frame


def test_a_trajectory_larger_than_memory_is_opened_and_only_reading_it_whole_refused(folder, monkeypatch):
    monkeypatch.setattr("cconv.data.limits.memory_limit", lambda: 10 * 64 * 2 * 4)  # ten frames of positions
    dataset = open_dataset(folder)
    assert len(dataset.source.read("train/00000", 3, 8)) == 5
    with pytest.raises(DataError, match="more than .* half of the memory that is free; cut it into shorter"):
        dataset.trajectory("train", 0)


@pytest.mark.parametrize("command", ["generate", "import"])
def test_a_data_set_larger_than_the_disk_is_refused_before_it_is_written(command, cconv, monkeypatch, tmp_path):
    monkeypatch.setattr("cconv.data.folders.shutil.disk_usage", lambda place: SimpleNamespace(free=1000))
    out = tmp_path / "out"
    if command == "generate":
        asked = cconv("data", "generate", "taylor_green_2d", "--size", "small", "--out", out)
    else:
        for number in range(12):
            np.save(tmp_path / f"run_{number}.npy", np.random.default_rng(number).random((40, 2)))
        options = ("--dt", "0.1", "--particle-spacing", "0.1")
        asked = cconv("data", "import", tmp_path / "run_*.npy", "--out", out, *options)
    status, _, error = asked  # the import says first what it found
    assert_one_clear_line((status, "", error), "would be written", "make room")
    assert not out.exists()
