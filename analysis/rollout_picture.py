"""A few frames of a rollout below the stored ones, coloured by speed, as one picture.

    python analysis/rollout_picture.py ROLLOUT PICTURE [--frames 6 36 66 125]

ROLLOUT is a folder that `cconv rollout --out` wrote; frames count from the first of its window.
"""

import argparse
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

from cconv import open_dataset
from cconv.data.trajectory import ParticleType
from cconv.report.particles import write_picture

FASTEST = 0.99  # quantile of the stored speeds at which the colours end

WIDTH = 2.1  # of a frame, inches
AREA = 1.5  # of a particle, points²


def main() -> None:
    """Draw the picture."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("rollout", type=Path)
    parser.add_argument("picture", type=Path)
    parser.add_argument("--frames", type=int, nargs="+", default=[6, 36, 66, 125])
    arguments = parser.parse_args()
    written = open_dataset(arguments.rollout)
    rows = {"stored": written.trajectory("valid", 0), "rolled out": written.trajectory("test", 0)}
    (low, bottom), (high, top) = written.scene.box.lower, written.scene.box.upper
    height = 2 * WIDTH * (top - bottom) / (high - low) + 1
    size = (WIDTH * len(arguments.frames), height)
    figure, axes = plt.subplots(2, len(arguments.frames), figsize=size, layout="compressed", squeeze=False)
    for column, frame in zip(axes.T, arguments.frames, strict=True):
        speeds = {title: row[frame].velocities.norm(dim=1).numpy() for title, row in rows.items()}
        fastest = np.quantile(speeds["stored"], FASTEST)
        for panel, (title, row) in zip(column, rows.items(), strict=True):
            points, solid = row[frame].positions.numpy(), row[frame].particle_types != ParticleType.FLUID
            panel.scatter(*points[solid].T, s=AREA, color="0.7", lw=0)
            drawn = panel.scatter(*points[~solid].T, s=AREA, c=speeds[title][~solid], vmin=0, vmax=fastest, lw=0)
            panel.set(xlim=(low, high), ylim=(bottom, top), aspect="equal", xticks=[], yticks=[])
        column[0].set_title(f"frame {frame}, t = {frame * written.scene.frame_dt:.3g}", fontsize=10)
        figure.colorbar(drawn, ax=list(column), orientation="horizontal", label="speed", shrink=0.85)
    for panel, title in zip(axes[:, 0], rows, strict=True):
        panel.set_ylabel(title)
    write_picture(figure, arguments.picture)


if __name__ == "__main__":
    main()
