"""Memory of a prediction, measured in a separate process for each model."""

import sys
from collections.abc import Callable, Mapping
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from multiprocessing.connection import Connection
from pathlib import Path

import torch

from cconv.data.trajectory import Frame, Scene
from cconv.data.window import Window
from cconv.models.model import Model

Load = Callable[[Path], Model]


def peak_megabytes(
    load: Load, models: Mapping[str, Path], frame: Frame | Window, scene: Scene, threads: int
) -> dict[str, float]:
    """Measure how much two predictions of each model add to the peak memory of a fresh process, MB.

    Args:
        load: Reads a checkpoint folder.
        models: Checkpoint folder of each model.
        frame: Frame to predict.
        scene: Its scene.
        threads: Number of torch threads.
    """
    with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as pool:
        found = pool.submit(_of_each, load, tuple(models.values()), frame, scene, threads).result()
    return dict(zip(models, found, strict=True))


def _of_each(load: Load, paths: tuple[Path, ...], frame: Frame | Window, scene: Scene, threads: int) -> list[float]:
    """Run one process after another, one for each model.

    On Linux they are forked from this one, so that imports happen once; elsewhere forking is not safe with threads.
    """
    context = get_context("fork") if sys.platform == "linux" else get_context("spawn")
    found: list[float] = []
    for path in paths:
        receiver, sender = context.Pipe(duplex=False)
        child = context.Process(target=_send_growth, args=(sender, load, path, frame, scene, threads))
        child.start()
        sender.close()  # so that the death of a child ends the file here
        found.append(receiver.recv())
        child.join()
    return found


def _send_growth(sender: Connection, load: Load, path: Path, frame: Frame | Window, scene: Scene, threads: int) -> None:
    torch.set_num_threads(threads)
    model = load(path)
    before = peak_resident_megabytes()
    for _ in range(2):
        model.predict_frame(frame, scene)
    sender.send(peak_resident_megabytes() - before)


def device_megabytes(model: Model, frame: Frame | Window, scene: Scene) -> float:
    """Measure how much a prediction adds to what torch holds on an NVIDIA GPU, MB."""
    placed = frame.to(model.home)
    torch.cuda.synchronize(model.device)
    torch.cuda.reset_peak_memory_stats(model.device)
    before = torch.cuda.memory_allocated(model.device)
    model.predict_frame(placed, scene)
    torch.cuda.synchronize(model.device)
    return (torch.cuda.max_memory_allocated(model.device) - before) / 2**20


def peak_resident_megabytes() -> float:
    """Return the peak memory of this process; on Linux from /proc, as `getrusage` would return the parent's peak."""
    status = Path("/proc/self/status")
    if not status.is_file():
        import resource  # which Unix has alone

        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
    line = next(line for line in status.read_text().splitlines() if line.startswith("VmHWM"))
    return int(line.split()[1]) / 1024
