"""A few frames of rollouts below the stored ones, coloured by speed or density, as one picture.

    python analysis/rollout_picture.py ROLLOUT [ROLLOUT ...] PICTURE [--labels plain relaxed] [--frames 6 36 66 125]
        [--color density]

Each ROLLOUT is a folder that `cconv rollout --out` wrote, all of one start; frames count from the first of its window.
Densities are sums over the particles of all types, relative to that at rest; colours end at 0.98 and 1.02.
"""

import argparse
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

from cconv import open_dataset, radius_graph
from cconv.data.trajectory import Frame, ParticleType, Scene
from cconv.report.particles import write_picture
from cconv.sph import QuinticSpline, density

FASTEST = 0.99  # quantile of the stored speeds at which the colours end
LIMITS = (0.98, 1.02)  # densities at which the colours end
WIDTH = 2.1  # of a frame, inches
AREA = 1.5  # of a particle, points²


@dataclass(frozen=True)
class Coloring:
    """How particles are coloured: their values, and the limits of the colours for the values of the stored frame."""

    label: str
    cmap: str
    values: Callable[[Frame, Scene], np.ndarray]
    limits: Callable[[np.ndarray], tuple[float, float]]


def speeds(frame: Frame, scene: Scene) -> np.ndarray:
    """Speed of each particle (N,), length per time."""
    return frame.velocities.norm(dim=1).numpy()


def densities(frame: Frame, scene: Scene) -> np.ndarray:
    """Density of each particle (N,), where dx^D has the mass 1."""
    kernel = QuinticSpline(scene.particle_spacing, scene.dim)
    edges = radius_graph(frame.positions.double(), kernel.support_radius, scene.box)
    volumes = frame.masses.double().new_full((len(frame.masses),), scene.particle_spacing**scene.dim)
    return density(volumes, edges, kernel).numpy()


COLORINGS = {
    "speed": Coloring("speed", "viridis", speeds, lambda stored: (0.0, float(np.quantile(stored, FASTEST)))),
    "density": Coloring("density ÷ density at rest", "coolwarm", densities, lambda stored: LIMITS),
}


def main() -> None:
    """Draw the picture."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("rollouts", type=Path, nargs="+")
    parser.add_argument("picture", type=Path)
    parser.add_argument("--labels", nargs="+", help="names of the rollouts; by default those of their folders")
    parser.add_argument("--frames", type=int, nargs="+", default=[6, 36, 66, 125])
    parser.add_argument("--color", choices=COLORINGS, default="speed")
    arguments = parser.parse_args()
    coloring = COLORINGS[arguments.color]
    written = [open_dataset(folder) for folder in arguments.rollouts]
    labels = arguments.labels or [folder.name for folder in arguments.rollouts]
    scene = written[0].scene
    rows = {"stored": written[0].trajectory("valid", 0)}
    rows |= {label: each.trajectory("test", 0) for label, each in zip(labels, written, strict=True)}
    (low, bottom), (high, top) = scene.box.lower, scene.box.upper
    height = len(rows) * WIDTH * (top - bottom) / (high - low) + 1
    size = (WIDTH * len(arguments.frames), height)
    figure, axes = plt.subplots(len(rows), len(arguments.frames), figsize=size, layout="compressed", squeeze=False)
    for column, number in zip(axes.T, arguments.frames, strict=True):
        values = {title: coloring.values(row[number], scene) for title, row in rows.items()}
        smallest, largest = coloring.limits(values["stored"])
        for panel, (title, row) in zip(column, rows.items(), strict=True):
            points, solid = row[number].positions.numpy(), row[number].particle_types != ParticleType.FLUID
            panel.scatter(*points[solid].T, s=AREA, color="0.7", lw=0)
            drawn = panel.scatter(
                *points[~solid].T,
                s=AREA,
                c=values[title][~solid],
                vmin=smallest,
                vmax=largest,
                cmap=coloring.cmap,
                lw=0,
            )
            panel.set(xlim=(low, high), ylim=(bottom, top), aspect="equal", xticks=[], yticks=[])
        column[0].set_title(f"frame {number}, t = {number * scene.frame_dt:.3g}", fontsize=10)
        figure.colorbar(drawn, ax=list(column), orientation="horizontal", label=coloring.label, shrink=0.85)
    for panel, title in zip(axes[:, 0], rows, strict=True):
        panel.set_ylabel(title)
    write_picture(figure, arguments.picture)


if __name__ == "__main__":
    main()
