"""Generation of data sets: the solver computes scenes in the LagrangeBench layout with our extra members.

Finished trajectories are kept in a folder beside the one to write until all are done, so that a killed run continues
where it stopped.
"""

import hashlib
import json
import shutil
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, replace
from pathlib import Path
from typing import NamedTuple

import torch
from filelock import Timeout
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file

from cconv import scenes, sph
from cconv.data.folders import check_free, check_room
from cconv.data.hdf5 import FILES, LEAST_COMPRESSED, write_splits
from cconv.data.metadata import OWN_KEY
from cconv.data.side_by_side import available_cores, side_by_side
from cconv.data.simulate import Simulation, simulate
from cconv.data.source import SPLITS, STORED
from cconv.data.splits import share_out, split_in_time
from cconv.data.trajectory import Boundary, Scene, Trajectory
from cconv.errors import ConfigError, DataError
from cconv.files import held
from cconv.scenes.simulated_scene import SimulatedScene

Progress = Callable[[Iterable, str], Iterable]
SPLIT_FRACTIONS = (0.5, 0.25, 0.25)  # as in LagrangeBench
_REQUEST, _LOCK, _WRITING, _SUFFIX, _PARTIAL = "request.json", "lock", "writing", ".safetensors", ".partial"


class Generated(NamedTuple):
    """The result of `generate`.

    Attributes:
        reused: Trajectories that an earlier run had finished.
        failures: One line for every simulation that blew up and was replaced by one with another initial state.
    """

    reused: int
    failures: tuple[str, ...]


def generate(
    scene: SimulatedScene,
    folder: str | Path,
    *,
    num_trajectories: int | None = None,
    num_frames: int | None = None,
    seed: int = 0,
    workers: int | None = None,
    overwrite: bool = False,
    progress: Progress = lambda items, label: items,
) -> Generated:
    """Write trajectories of a scene, split 2:1:1 into train, valid and test files; a single one is cut in time.

    The same scene, seed and numbers give the same bytes, however many workers. A run that is killed leaves the
    trajectories that it finished in ``FOLDER.unfinished``; the same call continues from there, also with another
    number of trajectories. In a script, several workers need the call to stand under ``if __name__ == "__main__":``.

    Args:
        scene: Scene to compute.
        folder: Folder to write.
        num_trajectories: 1, or at least 3; the scene's own number by default.
        num_frames: Frames of each, the start included; the scene's own number by default.
        seed: Seed of the initial states.
        workers: Number of processes; by default one for each core.
        overwrite: Whether an older data set in `folder`, or unfinished ones with other settings, may be replaced.
        progress: Wraps the frames to show progress, given a label.

    Raises:
        ConfigError: If a setting cannot be, or the folder exists and must not be replaced.
        DataError: If a trajectory cannot be written.
        SimulationError: If trajectories blow up again and again.
    """
    folder = Path(folder).absolute()
    count = scene.num_trajectories if num_trajectories is None else num_trajectories
    frames = scene.num_frames if num_frames is None else num_frames
    _check_numbers(count, frames, workers)
    unfinished, request = folder.with_name(f"{folder.name}.unfinished"), _request(scene, frames, seed)
    may_replace = overwrite or ((unfinished / _WRITING).exists() and _read(unfinished / _REQUEST) == request)
    check_free(folder, FILES, may_replace)
    with _unfinished_folder(unfinished, request, overwrite):
        files = [unfinished / f"{index:05d}{_SUFFIX}" for index in range(count)]
        calls = [(scene, frames, seed, index, file) for index, file in enumerate(files) if not _is_whole(file)]
        check_room(folder, _least_bytes(scene, frames, count, len(calls)))
        workers = max(1, min(workers or available_cores(), len(calls)))
        for _ in progress(_Frames(calls, frames + scene.skipped_frames, workers), f"{scene.name}, frames"):
            pass
        (unfinished / _WRITING).touch()  # from now on the content of the folder is ours
        write_splits(folder, _describe(scene), _splits(scene, files, frames), _metadata(scene, frames), may_replace)
        failures = tuple(line for file in files for line in _facts(file)["failures"])
        shutil.rmtree(unfinished)
    return Generated(count - len(calls), failures)


def _least_bytes(scene: SimulatedScene, num_frames: int, count: int, unfinished: int) -> int:
    """Bytes that a data set takes at least: raw ones of trajectories yet to compute, and all of them compressed."""
    start = replace(scene, relaxation_steps=0).initial_state(torch.Generator().manual_seed(0))
    raw = 2 * 4 * num_frames * start.positions.numel()  # positions and velocities, float32
    return int(raw * (unfinished + LEAST_COMPRESSED * count))


def _check_numbers(num_trajectories: int, num_frames: int, workers: int | None) -> None:
    if workers is not None and workers < 1:
        raise ConfigError(f"`workers` must be at least 1, got {workers}.")
    if num_trajectories < 1 or num_trajectories == 2:
        raise ConfigError(
            f"`num_trajectories` must be at least {len(SPLITS)}, one a split, or 1, which is cut in time, "
            f"got {num_trajectories}."
        )
    least = len(SPLITS) if num_trajectories == 1 else 1
    if num_frames < least:
        raise ConfigError(f"`num_frames` must be at least {least}, got {num_frames}.")


class _Frames:
    """Iterator that computes trajectories with several workers, and yields about once for every frame."""

    def __init__(self, calls: list[tuple], frames_per_call: int, workers: int):
        self._calls, self._total, self._workers = calls, len(calls) * frames_per_call, workers

    def __len__(self) -> int:
        return self._total

    def __iter__(self) -> Iterator[None]:
        frames = (
            side_by_side(_compute, self._calls, self._workers)
            if self._workers > 1
            else (frame for call in self._calls for frame in _compute(*call))
        )
        for number, _ in enumerate(frames):
            if number < self._total:  # simulations that blew up are computed again, but not counted
                yield


def _compute(scene: SimulatedScene, num_frames: int, seed: int, index: int, file: Path) -> Iterator[None]:
    """Compute a trajectory and save it atomically."""
    simulation = yield from simulate(scene, num_frames, seed, index)
    partial = file.with_suffix(_PARTIAL)
    try:
        tensors = {name: value for name, value in vars(simulation).items() if isinstance(value, torch.Tensor)}
        facts = {"viscosity": simulation.viscosity, "failures": simulation.failures}
        save_file(tensors, partial, metadata={"facts": json.dumps(facts)})
        partial.rename(file)
    except (OSError, SafetensorError) as error:
        raise DataError(
            f"{file}: cannot be written ({error}); free some space and give the same command again, which keeps what "
            "is finished."
        ) from error
    finally:
        partial.unlink(missing_ok=True)


def _facts(file: Path) -> dict:
    """Return the facts stored beside the tensors: viscosity and failures."""
    with safe_open(file, framework="pt") as stored:
        return json.loads(stored.metadata()["facts"])


def _is_whole(file: Path) -> bool:
    """Tell whether an earlier run finished the trajectory; a file cut short by a crash does not count."""
    try:
        return bool(_facts(file))
    except (OSError, SafetensorError):
        return False


def _load(file: Path) -> Simulation:
    facts = _facts(file)
    with safe_open(file, framework="pt") as stored:
        tensors = {name: stored.get_tensor(name) for name in stored.keys()}  # noqa: SIM118 - not a dict
    return Simulation(**tensors, viscosity=facts["viscosity"], failures=tuple(facts["failures"]))


def _request(scene: SimulatedScene, num_frames: int, seed: int) -> dict:
    """Return everything that trajectories depend on, except their number: settings, seed and code."""
    settings = {"scene": scene.name, **asdict(scene), "num_trajectories": None, "num_frames": num_frames, "seed": seed}
    modules = sorted(file for folder in (sph, scenes) for file in Path(folder.__path__[0]).glob("*.py"))
    code = hashlib.sha256(b"".join(file.read_bytes() for file in modules)).hexdigest()
    return json.loads(json.dumps({**settings, "code": code}))


@contextmanager
def _unfinished_folder(unfinished: Path, request: dict, overwrite: bool) -> Iterator[None]:
    """The folder of finished trajectories, new or as an earlier run of the same request left it, for this process only.

    Raises:
        ConfigError: If it cannot be used.
    """
    try:
        unfinished.mkdir(parents=True, exist_ok=True)
        with held(unfinished / _LOCK):
            _prepare(unfinished, request, overwrite)
            yield
    except Timeout as error:
        raise ConfigError(f"{unfinished}: another process works on it; wait for it or name another folder.") from error
    except OSError as error:
        raise ConfigError(f"{unfinished}: cannot be used ({error.strerror or error}); name another folder.") from error


def _prepare(unfinished: Path, request: dict, overwrite: bool) -> None:
    """Keep the files of the request; delete those of another request only if they may be overwritten."""
    files = [file for file in unfinished.iterdir() if file.name != _LOCK]
    if files and _read(unfinished / _REQUEST) != request:
        others = [
            file.name
            for file in files
            if file.name not in (_REQUEST, _WRITING) and file.suffix not in (_SUFFIX, _PARTIAL)
        ]
        if others:
            raise ConfigError(f"{unfinished}: holds other things ({others[0]}); move them or name another folder.")
        if not overwrite:
            raise ConfigError(
                f"{unfinished}: holds the unfinished trajectories of another scene, seed, settings or version; finish "
                "that data set with its own command, delete the folder, or overwrite it."
            )
        for file in files:
            file.unlink()
    (unfinished / _REQUEST).write_text(json.dumps(request, indent=1) + "\n", encoding="utf-8")


def _read(note: Path) -> object:
    try:
        return json.loads(note.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None


def _splits(scene: SimulatedScene, files: list[Path], num_frames: int) -> dict[str, Iterable[Trajectory]]:
    """Trajectories of each split, read one at a time."""
    if len(files) == 1:
        blocks = split_in_time("0", num_frames, SPLIT_FRACTIONS, gap=0)
        return {
            split: (_trajectory(scene, files[0], block.start, block.stop) for block in members)
            for split, members in zip(SPLITS, blocks, strict=True)
        }
    splits: dict[str, Iterable[Trajectory]] = {}
    start = 0
    for split, count in zip(SPLITS, share_out(len(files), SPLIT_FRACTIONS), strict=True):
        members = files[start : start + count]
        splits[split] = (_trajectory(scene, file, 0, num_frames) for file in members)
        start += count
    return splits


def _trajectory(scene: SimulatedScene, file: Path, start: int, stop: int | None) -> Trajectory:
    simulation = _load(file)
    particles = len(simulation.particle_types)
    boundary = scene.boundary
    return Trajectory(
        name=scene.name,
        first_frame=start,
        positions=simulation.positions[start:stop],
        velocities=simulation.velocities[start:stop],
        masses=simulation.masses,
        particle_types=simulation.particle_types,
        boundary=boundary and Boundary(positions=boundary[0].float(), normals=boundary[1].float()),
        viscosities=torch.full((particles,), simulation.viscosity) if scene.varying_viscosity else None,
    )


def _describe(scene: SimulatedScene) -> Scene:
    features = scene.features
    return Scene(
        name=scene.name,
        dim=scene.dim,
        particle_spacing=scene.particle_spacing,
        frame_dt=scene.frame_dt,
        box=scene.box,
        force=scene.force,
        has_boundary=features["walls"],
        velocity_source=STORED,
        mass_source=STORED,
        missing=(),
    )


def _metadata(scene: SimulatedScene, num_frames: int) -> dict:
    return {
        "case": scene.case,
        "solver": "SPH",
        "density_evolution": scene.density_scheme == "evolution",
        "dt": scene.time_step,
        "t_end": (num_frames - 1) * scene.frame_dt,
        "viscosity": scene.viscosity,
        "p_bg_factor": scene.background_pressure,
        "g_ext_magnitude": scene.largest_force,
        "artificial_alpha": scene.artificial_viscosity,
        "free_slip": False,
        "write_every": scene.steps_per_frame,
        "is_bc_trick": len(scene.walls) > 0,
        OWN_KEY: {"source": scene.source, "features": scene.features},
    }
