"""Generated data sets: same bytes for a seed, split, cut in time, resumed after a kill, never half-written."""

import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
import torch
from processes import PATIENCE
from safetensors import SafetensorError

from cconv.data import generate as module
from cconv.data.dataset import open_dataset
from cconv.data.generate import SPLIT_FRACTIONS, generate
from cconv.data.simulate import simulate
from cconv.data.splits import share_out
from cconv.errors import ConfigError, DataError, SimulationError
from cconv.evaluation.statistics import FEWEST
from cconv.scenes import scene_named

pytestmark = pytest.mark.integration

FILES = ("train.h5", "valid.h5", "test.h5", "metadata.json")


def tiny(name="taylor_green_2d", **settings):
    quick = {"relaxation_steps": 5, "steps_per_frame": 2, "skipped_frames": 0, **settings}
    return scene_named(name, "small", **quick)


def made(folder, scene=None, **settings):
    done = generate(scene or tiny(), folder, **{"num_trajectories": 4, "num_frames": 4, "workers": 1, **settings})
    return open_dataset(folder), done


def test_same_seed_gives_the_same_bytes_whatever_the_workers_and_another_seed_others(tmp_path):
    made(tmp_path / "a", seed=1)
    made(tmp_path / "b", seed=1, workers=2)
    made(tmp_path / "c", seed=2)
    for name in FILES:
        first, again, other = ((tmp_path / folder / name).read_bytes() for folder in "abc")
        assert first == again
        assert name == "metadata.json" or again != other


def test_trajectories_are_split_two_to_one_to_one(tmp_path):
    dataset, _ = made(tmp_path / "a")
    assert {split: len(blocks) for split, blocks in dataset.splits.items()} == {"train": 2, "valid": 1, "test": 1}
    starts = [dataset.trajectory(split, k).positions[0] for split, k in (("train", 0), ("train", 1), ("test", 0))]
    assert not torch.equal(starts[0], starts[1])
    assert not torch.equal(starts[1], starts[2])


def test_the_data_of_the_quick_study_have_units_enough_for_intervals():
    makefile = (Path(__file__).parents[2] / "Makefile").read_text()
    (count,) = re.findall(r"data generate dam_break_2d .*--trajectories (\d+)", makefile)
    assert all(share_out(int(count), SPLIT_FRACTIONS)[place] >= FEWEST for place in (1, 2))  # validation and test


def test_a_single_trajectory_is_cut_in_time(tmp_path):
    whole = _whole(tiny("reverse_poiseuille_2d"), 8)
    dataset, _ = made(tmp_path / "a", tiny("reverse_poiseuille_2d"), num_trajectories=1, num_frames=8)
    parts = [dataset.trajectory(split, 0).positions for split in ("train", "valid", "test")]
    assert [len(part) for part in parts] == [4, 2, 2]
    assert torch.equal(torch.cat(parts), whole.positions)


def test_frames_before_the_first_stored_are_skipped():
    skipping = _whole(tiny("reverse_poiseuille_2d", skipped_frames=3), 2)
    whole = _whole(tiny("reverse_poiseuille_2d"), 5)
    assert torch.equal(skipping.positions, whole.positions[3:])


def _whole(scene, frames):
    going = simulate(scene, frames, 0, 0)
    try:
        while True:
            next(going)
    except StopIteration as end:
        return end.value


def test_stored_velocities_are_those_the_particles_move_with(tmp_path):
    dataset, _ = made(tmp_path / "a", tiny(steps_per_frame=1), num_frames=6)
    trajectory, scene = dataset.trajectory("train", 0), dataset.scene
    steps = scene.box.displacement(trajectory.positions[1:], trajectory.positions[:-1]) / scene.frame_dt
    torch.testing.assert_close(steps, trajectory.velocities[1:], rtol=0.0, atol=2e-3)


def test_walls_are_stored_first_and_move_with_their_velocity(tmp_path):
    dataset, _ = made(tmp_path / "a", tiny("lid_driven_cavity_2d"), num_trajectories=1)
    trajectory = dataset.trajectory("train", 0)
    types = trajectory.particle_types
    assert types.tolist() == sorted(types.tolist(), key=lambda kind: kind == 0)
    moving = trajectory.velocities[:, types == 2]
    assert torch.equal(moving, torch.tensor([1.0, 0.0]).expand_as(moving))
    assert not trajectory.velocities[:, types == 1].any()


def test_a_start_that_blows_up_is_replaced_and_told(tmp_path, monkeypatch):
    blown = []

    def fail_once(state, scene):
        if not blown:
            blown.append(state)
            raise SimulationError("The simulation blew up at step 2.")

    monkeypatch.setattr("cconv.data.simulate._check_speed", fail_once)
    _, done = made(tmp_path / "a")
    assert len(done.failures) == 1
    assert done.failures[0].startswith("trajectory 0, start 1: The simulation blew up")


def test_a_scene_that_always_blows_up_gives_no_data(tmp_path, monkeypatch):
    monkeypatch.setattr(
        "cconv.scenes.taylor_green.TaylorGreen2D.velocity", lambda self, x, time: 1e3 * torch.ones_like(x)
    )
    with pytest.raises(SimulationError, match="All 5 starts of trajectory 0 blew up.*faster than sound"):
        made(tmp_path / "a")
    assert not (tmp_path / "a").exists()


def test_finished_trajectories_are_not_computed_again(tmp_path, monkeypatch):
    real, computed = module.simulate, []

    def counted(scene, frames, seed, index):
        computed.append(index)
        if len(computed) == 3:
            raise KeyboardInterrupt
        return (yield from real(scene, frames, seed, index))

    monkeypatch.setattr(module, "simulate", counted)
    with pytest.raises(KeyboardInterrupt):
        made(tmp_path / "a")
    assert not (tmp_path / "a").exists()
    _, done = made(tmp_path / "a")
    assert computed == [0, 1, 2, 2, 3]
    assert done.reused == 2
    made(tmp_path / "b")
    assert [(tmp_path / "a" / name).read_bytes() for name in FILES] == [
        (tmp_path / "b" / name).read_bytes() for name in FILES
    ]
    assert sorted(entry.name for entry in tmp_path.iterdir()) == ["a", "b"]


def test_unfinished_trajectories_of_other_settings_are_not_mixed_in(tmp_path, monkeypatch):
    with monkeypatch.context() as patched:
        patched.setattr(module, "_splits", _interrupt)
        with pytest.raises(KeyboardInterrupt):
            made(tmp_path / "a", seed=1)
    with pytest.raises(ConfigError, match="a.unfinished: holds the unfinished trajectories of another"):
        made(tmp_path / "a", seed=2)
    made(tmp_path / "a", seed=2, overwrite=True)
    made(tmp_path / "b", seed=2)
    assert (tmp_path / "a" / "train.h5").read_bytes() == (tmp_path / "b" / "train.h5").read_bytes()


@pytest.mark.slow
def test_a_killed_generation_goes_on_where_it_stopped(tmp_path):
    """`kill -9` of the whole process group; the command that is given again redoes no finished trajectory."""
    command = [
        Path(sys.executable).parent / "cconv", "data", "generate", "taylor_green_2d", "--size", "small", "--out",
        tmp_path / "a", "--trajectories", "6", "--frames", "20", "--workers", "2",
    ]  # fmt: skip
    running = subprocess.Popen(command, start_new_session=True, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    unfinished = tmp_path / "a.unfinished"
    deadline = time.monotonic() + PATIENCE
    while len(list(unfinished.glob("*.safetensors"))) < 2 and time.monotonic() < deadline:
        time.sleep(0.02)
    os.killpg(running.pid, signal.SIGKILL)
    running.wait()
    kept = list(unfinished.glob("*.safetensors"))
    assert 2 <= len(kept) < 6
    finished = subprocess.run(command, capture_output=True, text=True, timeout=PATIENCE)
    assert finished.returncode == 0, finished.stderr
    assert f"6 trajectories, {len(kept)} of them from an earlier run" in finished.stdout
    assert len(open_dataset(tmp_path / "a").splits["train"]) == 2
    assert not unfinished.exists()


def test_a_generation_that_is_killed_once_its_data_are_in_place_comes_to_its_end(tmp_path, monkeypatch):
    remove = module.shutil.rmtree

    def interrupt_at_the_end(path, **how):
        return _interrupt() if path.name == "a.unfinished" else remove(path, **how)

    with monkeypatch.context() as patched:
        patched.setattr(module.shutil, "rmtree", interrupt_at_the_end)
        with pytest.raises(KeyboardInterrupt):
            made(tmp_path / "a")
    left = subprocess.run([sys.executable, "-c", "import os; print(os.getpid())"], capture_output=True, text=True)
    (tmp_path / f".a.{left.stdout.strip()}.partial").mkdir()
    (tmp_path / f".a.{os.getppid()}.partial").mkdir()
    before = (tmp_path / "a" / "train.h5").read_bytes()
    _, done = made(tmp_path / "a")
    assert done.reused == 4
    assert (tmp_path / "a" / "train.h5").read_bytes() == before
    assert {path.name for path in tmp_path.iterdir()} == {"a", f".a.{os.getppid()}.partial"}
    with pytest.raises(ConfigError, match="exists and is not empty"):
        made(tmp_path / "a")


def test_a_full_disk_is_told_and_finished_trajectories_stay(tmp_path, monkeypatch):
    real, written = module.save_file, []

    def write_two(tensors, file, metadata):
        if len(written) == 2:
            file.write_bytes(b"half")
            raise SafetensorError("I/O error: No space left on device (os error 28)")
        written.append(file)
        real(tensors, file, metadata)

    monkeypatch.setattr(module, "save_file", write_two)
    with pytest.raises(DataError, match="00002.safetensors: cannot be written .*No space left"):
        made(tmp_path / "a")
    kept = sorted(entry.name for entry in (tmp_path / "a.unfinished").iterdir())
    assert kept == ["00000.safetensors", "00001.safetensors", "lock", "request.json"]
    assert not (tmp_path / "a").exists()


def test_files_that_were_cut_short_are_computed_again(tmp_path, monkeypatch):
    with monkeypatch.context() as patched:
        patched.setattr(module, "_splits", _interrupt)
        with pytest.raises(KeyboardInterrupt):
            made(tmp_path / "a")
    (tmp_path / "a.unfinished" / "00001.safetensors").write_bytes(b"")
    _, done = made(tmp_path / "a")
    assert done.reused == 3


def test_foreign_files_beside_unfinished_trajectories_survive(tmp_path):
    mine = tmp_path / "a.unfinished" / "thesis.tex"
    mine.parent.mkdir()
    mine.write_text("mine")
    with pytest.raises(ConfigError, match="holds other things .thesis.tex"):
        made(tmp_path / "a", overwrite=True)
    assert mine.read_text() == "mine"


def test_a_second_run_into_the_same_folder_is_refused(tmp_path, monkeypatch):
    def again(*_):
        with pytest.raises(ConfigError, match="another process works on it"):
            made(tmp_path / "a")
        raise KeyboardInterrupt

    monkeypatch.setattr(module, "_splits", again)
    with pytest.raises(KeyboardInterrupt):
        made(tmp_path / "a")


@pytest.mark.slow
def test_workers_end_with_their_parent_and_at_an_interrupt(tmp_path):
    """Even within a relaxation that would take minutes."""
    command = [
        Path(sys.executable).parent / "cconv", "data", "generate", "taylor_green_2d", "--out", tmp_path / "a",
        "--trajectories", "4", "--frames", "2000", "--workers", "2",
    ]  # fmt: skip
    for told in (signal.SIGINT, signal.SIGKILL):
        running = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        deadline = time.monotonic() + PATIENCE
        while len(_children(running.pid)) < 3 and time.monotonic() < deadline:  # two workers, one resource tracker
            time.sleep(0.05)
        time.sleep(2)
        children = _children(running.pid)
        running.send_signal(told)
        running.wait(timeout=PATIENCE)
        deadline = time.monotonic() + PATIENCE
        while any(Path(f"/proc/{child}/cmdline").exists() for child in children) and time.monotonic() < deadline:
            time.sleep(0.05)
        assert len(children) >= 2
        assert not any(Path(f"/proc/{child}/cmdline").exists() for child in children)
    assert not (tmp_path / "a").exists()


def _children(pid):
    return Path(f"/proc/{pid}/task/{pid}/children").read_text().split()


def _interrupt(*_):
    raise KeyboardInterrupt


def test_numbers_that_cannot_be_are_refused(tmp_path):
    for settings, message in (
        ({"num_trajectories": 2}, "num_trajectories"),
        ({"num_trajectories": 0}, "num_trajectories"),
        ({"num_frames": 0}, "num_frames"),
        ({"workers": 0}, "workers"),
        ({"num_trajectories": 1, "num_frames": 2}, "num_frames"),
    ):
        with pytest.raises(ConfigError, match=message):
            made(tmp_path / "a", **settings)
    assert list(tmp_path.iterdir()) == []


def test_an_older_data_set_is_kept_unless_overwritten(tmp_path):
    made(tmp_path / "a")
    before = (tmp_path / "a" / "train.h5").read_bytes()
    with pytest.raises(ConfigError, match="not empty"):
        made(tmp_path / "a", seed=1)
    assert (tmp_path / "a" / "train.h5").read_bytes() == before
    made(tmp_path / "a", seed=1, overwrite=True)
    assert (tmp_path / "a" / "train.h5").read_bytes() != before
