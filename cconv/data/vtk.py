"""Frames as VTK files for ParaView: one .vtu a frame and a .vtu.series that gives their times."""

import json
import re
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path

import meshio
import numpy as np
from torch import Tensor

from cconv.data.folders import whole_folder
from cconv.data.quantities import density_deviation, speed
from cconv.data.trajectory import Frame, Frames, Scene, check_frames, time_of


def write_vtk(
    folder: str | Path,
    trajectory: Frames,
    scene: Scene,
    frames: Sequence[int],
    overwrite: bool = False,
    progress: Callable[[Iterable, str], Iterable] = lambda items, label: items,
) -> Path:
    """Write frames as ``NAME_00000.vtu``, ... and ``NAME.vtu.series``; the folder appears when all is written.

    Every particle is a vertex cell with `velocity`, `speed`, `density_deviation` (see `cconv.data.quantities`), `mass`
    and `particle_type`. Below three dimensions positions and velocities are filled up with zeros. Lengths and times are
    in the units of the data.

    Args:
        folder: Where to write.
        trajectory: The trajectory to write.
        scene: Scene of the trajectory.
        frames: Indices of frames within the trajectory.
        overwrite: Whether older VTK files of the scene in `folder` may be replaced.
        progress: Wraps the frames to show progress, given a label.

    Returns:
        The .vtu.series file, which ParaView opens.

    Raises:
        ConfigError: If a frame is out of range, or the folder exists and must not be replaced.
    """
    check_frames(trajectory, frames)
    folder, name = Path(folder), re.sub(r"[^\w.-]", "_", scene.name)
    names = {k: f"{name}_{k:05d}.vtu" for k in frames}
    series = f"{name}.vtu.series"
    older = [file.name for file in folder.glob(f"{name}_*.vtu")]
    with whole_folder(folder, [series, *names.values(), *older], overwrite) as partial:
        for k in progress(frames, "vtk"):
            _mesh(trajectory[k], scene).write(partial / names[k])
        files = [{"name": names[k], "time": time_of(trajectory, k, scene.frame_dt)} for k in frames]
        content = json.dumps({"file-series-version": "1.0", "files": files}, indent=1)
        (partial / series).write_text(content + "\n", encoding="utf-8")
    return folder / series


def _mesh(frame: Frame, scene: Scene) -> meshio.Mesh:
    points = _padded(frame.positions)
    return meshio.Mesh(
        points,
        [("vertex", np.arange(len(points))[:, None])],
        point_data={
            "velocity": _padded(frame.velocities),
            "speed": speed(frame).numpy(),
            "density_deviation": density_deviation(frame, scene).numpy(),
            "mass": frame.masses.numpy(),
            "particle_type": frame.particle_types.numpy(),
        },
    )


def _padded(vectors: Tensor) -> np.ndarray:
    """Vectors (N, D) as (N, 3), the last components zero."""
    return np.pad(vectors.numpy(), ((0, 0), (0, 3 - vectors.shape[1])))
