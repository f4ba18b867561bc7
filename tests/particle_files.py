"""Tiny files of particle data for tests, written without the readers' own code."""

import json

import h5py
import msgpack
import numpy as np
import zstandard

FRAME_DT = 0.02


def encode(value):
    """An array or scalar as msgpack-numpy encodes it."""
    value = np.asarray(value)
    if value.ndim == 0:
        return {b"nd": False, b"type": value.dtype.str, b"data": value.tobytes()}
    return {b"nd": True, b"type": value.dtype.str, b"kind": b"", b"shape": value.shape, b"data": value.tobytes()}


def record_frames(num_frames=12, num_particles=5, first_id=0, mass=0.0, dim=3, seed=0):
    """Frames of particles that fall: each moves by its own velocity times FRAME_DT, as in semi-implicit Euler."""
    rng = np.random.default_rng(seed)
    positions = rng.random((num_particles, dim))
    velocities = rng.standard_normal((num_particles, dim))
    frames = []
    for index in range(num_frames):
        frames.append(
            {
                "pos": positions.astype("f4"),
                "vel": velocities.astype("f4"),
                "m": np.full(num_particles, mass, "f4"),
                "viscosity": np.full(num_particles, 0.01, "f4"),
                "frame_id": np.int64(first_id + index),
                "scene_id": "scene",
            }
        )
        velocities = velocities - np.eye(dim)[1] * 9.81 * FRAME_DT
        positions = positions + FRAME_DT * velocities
    return frames


def walls(num_points=4):
    """Corner points of a unit square in 3D and their normals."""
    points = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 1], [0, 1, 1]], "f4")[:num_points]
    return points, np.tile(np.array([0, 1, 0], "f4"), (num_points, 1))


def write_records(file, frames, with_walls=True):
    """Write frames as one `.msgpack.zst` file; wall points go to the first one."""
    frames = [dict(frame) for frame in frames]
    if with_walls:
        frames[0]["box"], frames[0]["box_normals"] = walls()
    encoded = [
        {key: encode(value) if isinstance(value, np.ndarray | np.generic) else value for key, value in frame.items()}
        for frame in frames
    ]
    write_packed(file, msgpack.packb(encoded, use_bin_type=True))


def write_packed(file, packed):
    """Write bytes zstd-compressed."""
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_bytes(zstandard.ZstdCompressor().compress(packed))


def write_parts(folder, name="sim", frames=None, part_length=5, **kwargs):
    """Write one trajectory as several files."""
    frames = record_frames() if frames is None else frames
    for part, start in enumerate(range(0, len(frames), part_length)):
        write_records(folder / f"{name}_{part:02d}.msgpack.zst", frames[start : start + part_length], **kwargs)


METADATA = {
    "case": "TGV",
    "solver": "SPH",
    "dim": 2,
    "dx": 0.1,
    "dt": 0.001,
    "write_every": 10,
    "viscosity": 0.01,
    "g_ext_magnitude": 0.0,
    "periodic_boundary_conditions": [True, True, True],
    "bounds": [[0.0, 1.0], [0.0, 2.0]],
}


def write_hdf5(folder, metadata=None, types=(0, 0, 0, 0), num_frames=6, **members):
    """Write a LagrangeBench folder with one trajectory a split; `members` are added to each group."""
    folder.mkdir(parents=True, exist_ok=True)
    types = np.array(types)
    for seed, split in enumerate(("train", "valid", "test")):
        rng = np.random.default_rng(seed)
        start = rng.random((len(types), 2))
        speeds = np.where(types[:, None] == 0, rng.standard_normal((len(types), 2)), 0.0)
        frames = start + 0.01 * np.arange(num_frames)[:, None, None] * speeds
        with h5py.File(folder / f"{split}.h5", "w") as file:
            group = file.create_group("00000")
            group["position"] = (frames % [1.0, 2.0]).astype("f4")
            group["particle_type"] = types
            for key, values in members.items():
                group[key] = values
    (folder / "metadata.json").write_text(json.dumps({**METADATA, **(metadata or {})}))
