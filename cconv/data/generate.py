"""Data sets of scenes, computed by the solver, in the LagrangeBench layout with our extra members.

Finished trajectories wait in a folder beside the one to write until all are there, so that a run that was killed goes
on where it stopped.
"""

import json
import multiprocessing
import os
import shutil
import signal
import threading
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import FIRST_EXCEPTION, Future, ProcessPoolExecutor, wait
from dataclasses import asdict
from pathlib import Path
from typing import NamedTuple

import torch
from safetensors import safe_open
from safetensors.torch import save_file

from cconv.data.folders import check_free
from cconv.data.hdf5 import FILES, write_dataset
from cconv.data.metadata import OWN_KEY
from cconv.data.simulate import Simulation, simulate
from cconv.data.source import SPLITS, STORED
from cconv.data.splits import share_out, split_in_time
from cconv.data.trajectory import Boundary, Scene, Trajectory
from cconv.errors import ConfigError
from cconv.scenes.simulated_scene import SimulatedScene

Progress = Callable[[Iterable, str], Iterable]
SPLIT_FRACTIONS = (0.5, 0.25, 0.25)  # as LagrangeBench
_REQUEST = "request.json"


class Generated(NamedTuple):
    """What `generate` did.

    Attributes:
        reused: Trajectories that an earlier run had finished.
        failures: One line for every start that blew up and was replaced by another.
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

    The same scene, seed and numbers give the same bytes, however many workers. A run that is killed leaves what it
    finished in ``FOLDER.unfinished``; the same call goes on from there, also with another number of trajectories.

    Args:
        scene: What to compute.
        folder: Where to write.
        num_trajectories: 1, or at least 3; the scene's own number by default.
        num_frames: Frames of each, the start included; the scene's own number by default.
        seed: Seed of the starts.
        workers: Processes side by side; as many as there are cores by default.
        overwrite: Whether an older data set in `folder`, or unfinished ones with other settings, may be replaced.
        progress: Wraps the frames to show progress, given a label.

    Raises:
        ConfigError: If a setting cannot be, or the folder exists and must not be replaced.
        SimulationError: If trajectories blow up again and again.
    """
    folder = Path(folder).absolute()
    count = scene.num_trajectories if num_trajectories is None else num_trajectories
    frames = scene.num_frames if num_frames is None else num_frames
    _check_numbers(count, frames)
    check_free(folder, FILES, overwrite)
    unfinished = folder.with_name(f"{folder.name}.unfinished")
    request = {"scene": scene.name, **asdict(scene), "num_trajectories": None, "num_frames": frames, "seed": seed}
    _open_unfinished(unfinished, json.loads(json.dumps(request)), overwrite)
    files = [unfinished / f"{index:05d}.safetensors" for index in range(count)]
    calls = [(scene, frames, seed, index, file) for index, file in enumerate(files) if not file.exists()]
    workers = max(1, min(workers or len(os.sched_getaffinity(0)), len(calls)))
    for _ in progress(_Frames(calls, frames + scene.skipped_frames, workers), f"{scene.name}, frames"):
        pass
    write_dataset(folder, _describe(scene), _splits(scene, files, frames), _metadata(scene, frames), overwrite)
    failures = tuple(line for file in files for line in _load(file).failures)
    shutil.rmtree(unfinished)
    return Generated(count - len(calls), failures)


def _check_numbers(num_trajectories: int, num_frames: int) -> None:
    if num_trajectories < 1 or num_trajectories == 2:
        raise ConfigError(
            f"`num_trajectories` must be at least {len(SPLITS)}, one a split, or 1, which is cut in time, "
            f"got {num_trajectories}."
        )
    least = len(SPLITS) if num_trajectories == 1 else 1
    if num_frames < least:
        raise ConfigError(f"`num_frames` must be at least {least}, got {num_frames}.")


class _Frames:
    """Computes trajectories, side by side where there are several workers; yields about once for every frame done."""

    def __init__(self, calls: list[tuple], frames_per_call: int, workers: int):
        self._calls, self._total, self._workers = calls, len(calls) * frames_per_call, workers

    def __len__(self) -> int:
        return self._total

    def __iter__(self) -> Iterator[None]:
        frames = (
            self._side_by_side() if self._workers > 1 else (frame for call in self._calls for frame in _compute(*call))
        )
        for number, _ in enumerate(frames):
            if number < self._total:  # starts that blew up are computed again, but not counted
                yield

    def _side_by_side(self) -> Iterator[None]:
        context = multiprocessing.get_context("spawn")
        counter, stop = context.Value("q", 0), context.Event()
        threads = max(1, len(os.sched_getaffinity(0)) // self._workers)
        with ProcessPoolExecutor(self._workers, context, _start_worker, (counter, stop, threads)) as pool:
            futures = [pool.submit(_compute_in_worker, *call) for call in self._calls]
            try:
                yield from _counted(futures, counter)
            finally:
                stop.set()
                pool.shutdown(cancel_futures=True)


def _counted(futures: list[Future], counter) -> Iterator[None]:
    """Yield whenever the counter grows, until all futures are done; raises what the first that failed raised."""
    shown, going = 0, set(futures)
    while going:
        finished, going = wait(going, timeout=0.1, return_when=FIRST_EXCEPTION)
        for future in finished:
            future.result()
        for _ in range(shown, counter.value):
            shown += 1
            yield


_progress: dict = {}  # what the parent of a worker process listens to


def _start_worker(counter, stop, threads: int) -> None:
    _progress.update(counter=counter, stop=stop)
    torch.set_num_threads(threads)
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent says when to stop
    threading.Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    multiprocessing.parent_process().join()
    os._exit(1)


def _compute_in_worker(*call) -> None:
    for _ in _compute(*call):
        with _progress["counter"].get_lock():
            _progress["counter"].value += 1
        if _progress["stop"].is_set():
            return


def _compute(scene: SimulatedScene, num_frames: int, seed: int, index: int, file: Path) -> Iterator[None]:
    """Compute a trajectory and save it, whole or not at all."""
    simulation = yield from simulate(scene, num_frames, seed, index)
    partial = file.with_suffix(".partial")
    try:
        tensors = {name: value for name, value in vars(simulation).items() if isinstance(value, torch.Tensor)}
        facts = {"viscosity": simulation.viscosity, "failures": simulation.failures}
        save_file(tensors, partial, metadata={"facts": json.dumps(facts)})
        partial.rename(file)
    finally:
        partial.unlink(missing_ok=True)


def _load(file: Path) -> Simulation:
    with safe_open(file, framework="pt") as stored:
        facts = json.loads(stored.metadata()["facts"])
        tensors = {name: stored.get_tensor(name) for name in stored.keys()}  # noqa: SIM118 - not a dict
    return Simulation(**tensors, viscosity=facts["viscosity"], failures=tuple(facts["failures"]))


def _open_unfinished(unfinished: Path, request: dict, overwrite: bool) -> None:
    """Make the folder of finished trajectories, or check that an older one holds what is asked for."""
    note = unfinished / _REQUEST
    if unfinished.exists() and _read(note) != request:
        if not overwrite:
            raise ConfigError(
                f"{unfinished}: holds the unfinished trajectories of another scene, seed or settings; finish that data "
                "set with its own command, delete the folder, or overwrite it."
            )
        shutil.rmtree(unfinished)
    unfinished.mkdir(parents=True, exist_ok=True)
    note.write_text(json.dumps(request, indent=1) + "\n", encoding="utf-8")


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
    splits, start = {}, 0
    for split, count in zip(SPLITS, share_out(len(files), SPLIT_FRACTIONS), strict=True):
        members = files[start : start + count]
        splits[split] = (_trajectory(scene, file, 0, num_frames) for file in members)
        start += count
    return splits


def _trajectory(scene: SimulatedScene, file: Path, start: int, stop: int) -> Trajectory:
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
    varies = "not constant; it depends on position, see the scene's file"
    return Scene(
        name=scene.name,
        dim=scene.dim,
        particle_spacing=scene.particle_spacing,
        frame_dt=scene.frame_dt,
        box=scene.box,
        force=scene.gravity,
        has_boundary=features["walls"],
        velocity_source=STORED,
        mass_source=STORED,
        missing=(f"force: {varies}",) if scene.has_force and scene.gravity is None else (),
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
