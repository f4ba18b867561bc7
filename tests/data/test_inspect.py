import json

import h5py
import numpy as np
import pytest
from particle_files import write_hdf5, write_parts

from cconv.data.dataset import open_dataset
from cconv.data.inspect import inspect_dataset
from cconv.errors import ConfigError, DataError


def lattice():
    """Sixteen particles of a periodic square lattice with spacing 0.25 that move along x, (6, 16, 2)."""
    ticks = (np.arange(4) + 0.5) / 4
    start = np.stack(np.meshgrid(ticks, ticks, indexing="ij"), axis=-1).reshape(16, 2)
    frames = start + 0.01 * np.arange(6)[:, None, None] * [3.0, 0.0]
    return (frames % 1.0).astype("f4")


def write_lattice(folder, **members):
    metadata = {"dx": 0.25, "bounds": [[0.0, 1.0], [0.0, 1.0]]}
    write_hdf5(folder, metadata, types=[0] * 16, **members)
    for split in ("train", "valid", "test"):
        with h5py.File(folder / f"{split}.h5", "a") as file:
            file["00000/position"][...] = lattice()


def test_lattice_has_the_neighbours_and_speed_of_a_lattice(tmp_path):
    write_lattice(tmp_path)
    facts = inspect_dataset(open_dataset(tmp_path), cutoff=0.26)
    assert facts["neighbors"] == {"cutoff": 0.26, "mean": 4.0, "min": 4, "max": 4}
    assert facts["speed"]["mean"] == pytest.approx(3.0, rel=1e-5)
    assert facts["speed"]["max"] == pytest.approx(3.0, rel=1e-4)
    assert facts["particles"] == {"fluid": {"min": 16, "max": 16}}
    assert facts["splits"]["train"] == {"trajectories": 1, "frames": 6}


def test_facts_survive_json(tmp_path):
    write_parts(tmp_path)
    facts = inspect_dataset(open_dataset(tmp_path))
    assert json.loads(json.dumps(facts, allow_nan=False)) == facts
    assert facts["boundary"] == {"points": {"min": 4, "max": 4}, "normals": True}
    assert facts["neighbors"]["cutoff"] == pytest.approx(0.1)
    assert facts["mass"] == {"min": 0.125, "max": 0.125}
    assert sum(counts["frames"] for counts in facts["splits"].values()) == 12 - 2 * 2


def test_every_trajectory_is_looked_at(tmp_path):
    write_lattice(tmp_path)
    with h5py.File(tmp_path / "test.h5", "a") as file:
        file["00000/position"][4] = np.nan
    with pytest.raises(DataError, match="test/00000, frame 4"):
        inspect_dataset(open_dataset(tmp_path), cutoff=0.26)


def test_usual_cutoff_fits_a_small_periodic_box(tmp_path):
    write_lattice(tmp_path)
    facts = inspect_dataset(open_dataset(tmp_path, particle_spacing=0.3))
    assert facts["neighbors"]["cutoff"] == 0.5


def test_cutoff_beyond_half_the_box_is_refused(tmp_path):
    write_lattice(tmp_path)
    with pytest.raises(ConfigError, match="cutoff"):
        inspect_dataset(open_dataset(tmp_path), cutoff=0.6)
