import pytest
import torch

from cconv.data.dataset import open_dataset
from cconv.data.generate import generate_taylor_green_2d
from cconv.errors import ConfigError

SMALL = {"num_trajectories": 4, "num_frames": 5, "particles_per_side": 8}


def generate(folder, **settings):
    generate_taylor_green_2d(folder, **{**SMALL, **settings})
    return open_dataset(folder)


def test_same_seed_gives_the_same_bytes_and_another_seed_others(tmp_path):
    generate(tmp_path / "a", seed=1)
    generate(tmp_path / "b", seed=1)
    generate(tmp_path / "c", seed=2)
    for name in ("train.h5", "valid.h5", "test.h5"):
        first, again, other = ((tmp_path / folder / name).read_bytes() for folder in "abc")
        assert first == again != other
    assert (tmp_path / "a" / "metadata.json").read_bytes() == (tmp_path / "b" / "metadata.json").read_bytes()


def test_sizes_are_as_asked_for(tmp_path):
    dataset = generate(tmp_path / "a")
    assert {split: len(blocks) for split, blocks in dataset.splits.items()} == {"train": 2, "valid": 1, "test": 1}
    trajectory = dataset.trajectory("train", 1)
    assert trajectory.positions.shape == (5, 64, 2)
    assert trajectory.positions.dtype == torch.float32
    assert (trajectory.positions >= 0).all()
    assert (trajectory.positions < 1).all()


def test_scene_lacks_nothing(tmp_path):
    scene = generate(tmp_path / "a").scene
    assert scene.missing == ()
    assert scene.velocity_source == scene.mass_source == "stored"
    assert scene.box.periodic == (True, True)
    assert scene.particle_spacing == 1 / 8
    assert scene.frame_dt == 0.01


def test_no_two_trajectories_are_alike(tmp_path):
    dataset = generate(tmp_path / "a")
    starts = [
        dataset.trajectory(split, k).positions[0] for split in dataset.splits for k in range(len(dataset.splits[split]))
    ]
    assert len({tuple(start.flatten().tolist()) for start in starts}) == 4


def test_total_mass_is_that_of_the_box_filled_with_density_one(tmp_path):
    masses = generate(tmp_path / "a").trajectory("train", 0).masses
    assert float(masses.sum()) == pytest.approx(1.0)


def test_stored_velocities_are_those_the_particles_move_with(tmp_path):
    dataset = generate(tmp_path / "a", frame_dt=1e-3)
    trajectory = dataset.trajectory("train", 0)
    steps = dataset.scene.box.displacement(trajectory.positions[2:].double(), trajectory.positions[:-2].double())
    torch.testing.assert_close(steps / 2e-3, trajectory.velocities[1:-1].double(), rtol=0, atol=1e-3)


@pytest.mark.parametrize(
    ("settings", "name"),
    [
        ({"num_trajectories": 2}, "num_trajectories"),
        ({"num_frames": 0}, "num_frames"),
        ({"particles_per_side": 3}, "particles_per_side"),
        ({"viscosity": -1.0}, "viscosity"),
        ({"frame_dt": 0.0}, "frame_dt"),
        ({"jitter": 0.6}, "jitter"),
    ],
)
def test_settings_that_cannot_be_are_named_and_nothing_is_written(tmp_path, settings, name):
    with pytest.raises(ConfigError, match=f"`{name}`"):
        generate(tmp_path / "a", **settings)
    assert list(tmp_path.iterdir()) == []


def test_existing_folder_is_refused_unless_overwritten(tmp_path):
    before = generate(tmp_path / "a", seed=1).fingerprint()
    with pytest.raises(ConfigError, match="overwrite"):
        generate(tmp_path / "a", seed=2)
    assert open_dataset(tmp_path / "a").fingerprint() == before
    assert generate(tmp_path / "a", seed=2, overwrite=True).fingerprint() != before
