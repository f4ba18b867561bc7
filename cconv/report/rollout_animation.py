"""The animation of a rollout beside the stored frames, as the report embeds it."""

import base64
import math
from collections.abc import Callable, Iterable
from pathlib import Path
from tempfile import TemporaryDirectory

from cconv.data.dataset import open_dataset
from cconv.data.stored_frames import StoredFrames
from cconv.report.particles import write_animation

MOST_FRAMES = 40


def animated(folder: Path) -> str | None:
    """Draw a rollout as GIF, in base64; None for a scene of one dimension.

    Args:
        folder: What `cconv.evaluation.recorded_rollout.write_rollout` wrote.

    Raises:
        DataError: If the folder is damaged.
    """
    with TemporaryDirectory() as place:
        file = Path(place) / "rollout.gif"
        return base64.b64encode(file.read_bytes()).decode() if animate(folder, file, MOST_FRAMES) else None


def animate(
    folder: Path,
    file: Path,
    most_frames: int,
    first_frame: int = 0,
    progress: Callable[[Iterable, str], Iterable] = lambda items, _: items,
) -> bool:
    """Write an animation of a rollout beside the stored frames, coloured by speed; tell whether there is one.

    Args:
        folder: What `cconv.evaluation.recorded_rollout.write_rollout` wrote.
        file: Where to write; .gif or .mp4 says as what.
        most_frames: Longer rollouts are drawn every few frames.
        first_frame: Index of the first frame within the stored trajectory.
        progress: Wraps the frames to show progress, given a label.
    """
    written = open_dataset(folder)
    if written.scene.dim == 1:
        return False
    splits = {"stored": "valid", "rollout": "test"}
    both = {title: StoredFrames(written, split, 0, first_frame) for title, split in splits.items()}
    count = len(both["rollout"])
    write_animation(file, both, written.scene, range(0, count, math.ceil(count / most_frames)), "speed", progress)
    return True
