"""A cube of fluid falls into a closed box: does a model of `position_correction` keep it inside?

    cconv import pretrained_model_weights.h5 --out runs/published
    python experiments/falling_cube.py runs/published --frames 200

The box is a cube of 20 particle spacings with points on its six sides, the fluid a cube of 8 that begins at rest in its
upper half; spacing and time between frames are those that the model was trained at. It prints, every so many frames,
how many particles are outside by more than a spacing, how far the farthest is, the height of the centre of mass and the
typical speed in spacings per frame, and in the end the farthest of all frames. The exit status is 1 if a particle left
the box, or the rollout ended early.
"""

import argparse
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import torch
from torch import Tensor

from cconv import load_model
from cconv.data.trajectory import Boundary, Scene
from cconv.data.window import Window
from cconv.domain import Box
from cconv.forces import ConstantForce
from cconv.models.model import Model
from cconv.rollout.rollout import Diverged, rollout
from cconv.scenes.cuboid_3d import Cuboid3D
from cconv.scenes.walls import lattice

CELLS, CUBE = 20, 8  # of the box and of the fluid, along each axis
GRAVITY = (0.0, -9.81, 0.0)
MARGIN = 1.0  # particle spacings beyond a side from which on a particle is outside


class State(NamedTuple):
    """What is said of a frame; lengths in particle spacings."""

    outside: int
    farthest: float
    height: float
    speed: float


def box_scene(spacing: float, frame_dt: float) -> tuple[Scene, Boundary]:
    """The box, with room around it so that particles can leave it, and the points on its sides."""
    side = CELLS * spacing
    positions, normals = Cuboid3D(particle_spacing=spacing, side=side).boundary
    scene = Scene(
        name="falling_cube",
        dim=3,
        particle_spacing=spacing,
        frame_dt=frame_dt,
        box=Box([-side] * 3, [2 * side] * 3),
        force=ConstantForce(GRAVITY),
        has_boundary=True,
        velocity_source="stored",
        mass_source="stored",
        missing=(),
    )
    return scene, Boundary(positions=positions.float(), normals=normals.float())


def falling_cube(scene: Scene, boundary: Boundary, history: int, cells: int = CUBE) -> Window:
    """A cube of so many cells along each axis, at rest in the middle of the box and three spacings below its top."""
    spacing = scene.particle_spacing
    lower = torch.tensor([(CELLS - cells) / 2, CELLS - cells - 3, (CELLS - cells) / 2]) * spacing
    positions = lattice([cells] * 3, spacing, lower.tolist())
    past = positions.expand(history, -1, -1)
    return Window(
        positions=past,
        future=past[:0],
        masses=torch.full((len(positions),), 1000.0 * spacing**3),
        particle_types=torch.zeros(len(positions), dtype=torch.int64),
        boundary=boundary,
        trajectory="falling_cube",
        frame=history - 1,
    )


def states(model: Model, frames: int, cells: int = CUBE) -> Iterator[State]:
    """Roll out and describe each frame.

    Raises:
        Diverged: If the rollout ends early.
    """
    spacing = model.config.particle_spacing
    scene, boundary = box_scene(spacing, model.config.frame_dt)
    start = falling_cube(scene, boundary, model.task.history, cells)
    before = start.present
    for _, window in zip(range(frames), rollout(model, start, scene), strict=False):
        yield _state(window.present, before, spacing)
        before = window.present


def _state(positions: Tensor, before: Tensor, spacing: float) -> State:
    cells = positions / spacing
    beyond = torch.maximum(-cells, cells - CELLS).amax(dim=1)
    return State(
        outside=int((beyond > MARGIN).sum()),
        farthest=float(beyond.max()),
        height=float(cells[:, 1].mean()),
        speed=float((positions - before).norm(dim=1).square().mean().sqrt() / spacing),
    )


def main() -> None:
    """Roll out and print a line every few frames."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("checkpoint", type=Path)
    parser.add_argument("--frames", type=int, default=200)
    parser.add_argument("--every", type=int, default=20, help="frames from one line to the next")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    model, found = load_model(arguments.checkpoint, task="position_correction"), []
    print("frame  outside  farthest  height  speed")
    try:
        for frame, state in enumerate(states(model, arguments.frames), start=1):
            found.append(state)
            if frame % arguments.every == 0 or frame == arguments.frames:
                print("{:5d}  {:7d}  {:8.3f}  {:6.2f}  {:.4f}".format(frame, *state), flush=True)
    except Diverged as error:
        sys.exit(f"the rollout ended early: {error}")
    outside = [frame for frame, state in enumerate(found, start=1) if state.outside]
    print(f"farthest of {len(found)} frames: {max(state.farthest for state in found):.3f} spacings beyond a side")
    sys.exit(f"particles were outside in {len(outside)} frames, first in {outside[0]}" if outside else 0)


if __name__ == "__main__":
    main()
