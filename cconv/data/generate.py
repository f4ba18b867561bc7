"""Data sets made on the spot, in our own layout."""

from collections.abc import Callable, Iterable, Iterator
from pathlib import Path

import numpy as np
import torch

from cconv.data.hdf5 import write_dataset
from cconv.data.source import SPLITS, STORED, uniform_masses
from cconv.data.splits import share_out
from cconv.data.trajectory import ParticleType, Scene, Trajectory
from cconv.errors import ConfigError
from cconv.scenes.taylor_green_2d import TaylorGreen2D

Progress = Callable[[Iterable, str], Iterable]
SPLIT_FRACTIONS = (0.7, 0.15, 0.15)


def generate_taylor_green_2d(
    folder: str | Path,
    *,
    num_trajectories: int = 8,
    num_frames: int = 40,
    seed: int = 0,
    overwrite: bool = False,
    progress: Progress = lambda items, label: items,
    **settings,
) -> None:
    """Write trajectories of the Taylor-Green scene, split into train, valid and test files.

    Trajectories differ in where the vortices stand and in how the starting lattice is jittered. Velocities and masses
    (rest density 1) are stored. The same seed and settings give the same bytes.

    Args:
        folder: Where to write.
        num_trajectories: How many, at least 3.
        num_frames: Frames of each, the start included.
        seed: Seed of phases and jitters.
        overwrite: Whether an older data set in `folder` may be replaced.
        progress: Wraps the trajectories of a split to show progress, given a label.
        **settings: Fields of `TaylorGreen2D`.

    Raises:
        ConfigError: If a setting cannot be, or the folder exists and must not be replaced.
    """
    if num_trajectories < len(SPLITS):
        raise ConfigError(f"`num_trajectories` must be at least {len(SPLITS)}, one a split, got {num_trajectories}.")
    if num_frames < 1:
        raise ConfigError(f"`num_frames` must be at least 1, got {num_frames}.")
    scene = TaylorGreen2D(**settings)
    splits, first = {}, 0
    for split, count in zip(SPLITS, share_out(num_trajectories, SPLIT_FRACTIONS), strict=True):
        splits[split] = progress(_Trajectories(scene, range(first, first + count), num_frames, seed), split)
        first += count
    metadata = {"case": "TGV", "solver": "analytic", "viscosity": scene.viscosity}
    write_dataset(Path(folder), _describe(scene), splits, metadata, overwrite)


class _Trajectories:
    """Trajectories made one at a time when asked for; knows their number, for progress."""

    def __init__(self, scene: TaylorGreen2D, indices: range, num_frames: int, seed: int):
        self._scene, self._indices, self._num_frames, self._seed = scene, indices, num_frames, seed

    def __len__(self) -> int:
        return len(self._indices)

    def __iter__(self) -> Iterator[Trajectory]:
        return (_simulate(self._scene, self._num_frames, [self._seed, index]) for index in self._indices)


def _simulate(scene: TaylorGreen2D, num_frames: int, seed: list[int]) -> Trajectory:
    generator = torch.Generator().manual_seed(int(np.random.SeedSequence(seed).generate_state(1, np.uint64)[0] >> 1))
    phase = scene.random_phase(generator)
    positions = [scene.initial_positions(generator)]
    for frame in range(num_frames - 1):
        positions.append(scene.advance(positions[-1], frame * scene.frame_dt, phase))
    velocities = [scene.velocity(at, frame * scene.frame_dt, phase) for frame, at in enumerate(positions)]
    # Rounding to float32 may reach the upper edge: wrap once more.
    stored = scene.box.wrap(torch.stack(positions).float())
    return Trajectory(
        name="taylor_green_2d",
        first_frame=0,
        positions=stored,
        velocities=torch.stack(velocities).float(),
        masses=uniform_masses(scene.particle_spacing**2, stored),
        particle_types=torch.full((stored.shape[1],), int(ParticleType.FLUID)),
        boundary=None,
    )


def _describe(scene: TaylorGreen2D) -> Scene:
    return Scene(
        name="taylor_green_2d",
        dim=2,
        particle_spacing=scene.particle_spacing,
        frame_dt=scene.frame_dt,
        box=scene.box,
        force=None,
        has_boundary=False,
        velocity_source=STORED,
        mass_source=STORED,
        missing=(),
    )
