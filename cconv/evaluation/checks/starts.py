"""Other starts of rollouts than the first stored frames: shaken, squeezed, scaled, turned, mirrored, and later."""

import math
from dataclasses import dataclass, replace
from functools import partial

import torch
from torch import Tensor

from cconv.data.trajectory import Boundary, Frames, Scene
from cconv.data.window import Window, window_at
from cconv.domain import Box
from cconv.forces import Accelerating, Force

SHAKEN = 0.05  # standard deviation of the shifts along each axis, particle spacings
SQUEEZED, SQUEEZED_WITHIN = 0.1, 4.0  # share that lengths lose at the centre of a ball, its radius in spacings
SCALED = 1.5  # factor of all lengths
SEED = 0  # of the random shifts


@dataclass(frozen=True, kw_only=True)
class Mapping:
    """A map of points to a matrix times them plus a shift; the matrix turns, mirrors or scales.

    Attributes:
        matrix: (D, D), with one entry other than 0 in each row and column.
        shift: (D,).
    """

    matrix: Tensor
    shift: Tensor

    def __call__(self, points: Tensor) -> Tensor:
        """Map points (..., D), float64."""
        return self.of_vectors(points) + self.shift

    def of_vectors(self, vectors: Tensor) -> Tensor:
        """Map vectors (..., D), float64."""
        return vectors.double() @ self.matrix.T

    def inverse(self, points: Tensor) -> Tensor:
        """Map points (..., D) back, float64."""
        return (points.double() - self.shift) @ torch.linalg.inv(self.matrix).T

    @property
    def factor(self) -> float:
        """By which lengths grow."""
        return float(self.matrix.abs().max())


@dataclass(frozen=True)
class MappedForce(Force):
    """A force of a scene as it acts where the scene is mapped to.

    Attributes:
        force: The force before.
        mapping: Maps the scene.
    """

    name = "mapped"
    force: Force
    mapping: Mapping

    @property
    def largest(self) -> float:
        """Magnitude before, times the factor of lengths."""
        return self.mapping.factor * self.force.largest

    def check(self, dim: int) -> None:
        """Check the force before the mapping; see `Force.check`."""
        self.force.check(dim)

    def __call__(self, positions: Tensor) -> Tensor:
        """Accelerations (N, D) at positions (N, D)."""
        return self._mapped(self.force, positions)

    def smoothed(self, deviation: float) -> Accelerating:
        """The smoothed force before the mapping, mapped; see `Force.smoothed`."""
        return partial(self._mapped, self.force.smoothed(deviation / self.mapping.factor))

    def _mapped(self, force: Accelerating, positions: Tensor) -> Tensor:
        return self.mapping.of_vectors(force(self.mapping.inverse(positions))).to(positions.dtype)


@dataclass(frozen=True, kw_only=True)
class Start:
    """A window that a rollout begins with, made from another one.

    Attributes:
        name: What was done to it.
        window: The window, its future as long as the rollout.
        scene: Its scene.
        mapping: Maps positions of the scene that it comes from to those of its own.
    """

    name: str
    window: Window
    scene: Scene
    mapping: Mapping


def other_starts(trajectory: Frames, scene: Scene, history: int, frames: int) -> tuple[Start, ...]:
    """Make the starts of rollouts in which models fail, from the first and the last window of a trajectory.

    Args:
        trajectory: The trajectory.
        scene: Its scene.
        history: Frames up to the present.
        frames: Frames after it.
    """
    first = window_at(trajectory, history - 1, history, frames)
    maps = {"scaled": _scaling(scene), "mirrored": _mirroring(scene)}
    if scene.dim > 1:
        maps["turned"] = _turning(scene)
    same = _keeping_the_corner(torch.eye(scene.dim, dtype=torch.float64), scene.box)
    windows = {
        "shaken": _shaken(first, scene),
        "squeezed": _squeezed(first, scene),
        "later": window_at(trajectory, len(trajectory) - 1 - frames, history, frames),
    }
    starts = [Start(name=name, window=window, scene=scene, mapping=same) for name, window in windows.items()]
    starts += [_mapped(name, first, scene, mapping) for name, mapping in maps.items()]
    return tuple(
        replace(each, window=replace(each.window, trajectory=f"{each.window.trajectory}, {each.name}"))
        for each in starts
    )


def _shaken(window: Window, scene: Scene) -> Window:
    """Shift every fluid particle at random, by the same in all frames, so that velocities stay as they are."""
    generator = torch.Generator().manual_seed(SEED)
    noise = torch.randn(window.present.shape, generator=generator, dtype=torch.float64)
    return _shifted(window, SHAKEN * scene.particle_spacing * noise, scene.box)


def _squeezed(window: Window, scene: Scene) -> Window:
    """Contract the fluid within a ball around the middle of the fluid, most at its centre; velocities stay."""
    present = window.present.double()
    from_center = scene.box.displacement(present, present[window.is_fluid].mean(dim=0))
    share = from_center.norm(dim=1, keepdim=True) / (SQUEEZED_WITHIN * scene.particle_spacing)
    return _shifted(window, -SQUEEZED * (1 - share).clamp(min=0) * from_center, scene.box)


def _shifted(window: Window, shift: Tensor, box: Box) -> Window:
    """Shift the fluid by (N, D) in every frame up to the present."""
    moved = window.positions.double() + torch.where(window.is_fluid[:, None], shift, 0.0)
    return replace(window, positions=box.wrap(moved))


def _scaling(scene: Scene) -> Mapping:
    """All lengths larger by a factor, the time between frames the same."""
    return _keeping_the_corner(SCALED * torch.eye(scene.dim, dtype=torch.float64), scene.box)


def _turning(scene: Scene) -> Mapping:
    """A quarter of a turn from the first axis to the second."""
    matrix = torch.eye(scene.dim, dtype=torch.float64)
    matrix[:2, :2] = torch.tensor([[0.0, -1.0], [1.0, 0.0]])
    return _keeping_the_corner(matrix, scene.box)


def _mirroring(scene: Scene) -> Mapping:
    """A reflection of the first axis."""
    signs = torch.ones(scene.dim, dtype=torch.float64)
    signs[0] = -1
    return _keeping_the_corner(signs.diag(), scene.box)


def _mapped(name: str, window: Window, scene: Scene, mapping: Mapping) -> Start:
    """The same flow in a box, among walls and under a force that are mapped with it."""
    box = _mapped_box(scene.box, mapping)
    other = replace(
        window,
        positions=box.wrap(mapping(window.positions)),
        future=box.wrap(mapping(window.future)),
        masses=window.masses * mapping.factor**scene.dim,
        boundary=None if window.boundary is None else _mapped_boundary(window.boundary, mapping),
    )
    force = None if scene.force is None else MappedForce(scene.force, mapping)
    spacing = mapping.factor * scene.particle_spacing
    return Start(
        name=name,
        window=other,
        scene=replace(scene, particle_spacing=spacing, box=box, force=force),
        mapping=mapping,
    )


def _mapped_boundary(boundary: Boundary, mapping: Mapping) -> Boundary:
    dtype = boundary.positions.dtype
    normals = None if boundary.normals is None else (mapping.of_vectors(boundary.normals) / mapping.factor).to(dtype)
    return Boundary(positions=mapping(boundary.positions).to(dtype), normals=normals)


def _keeping_the_corner(matrix: Tensor, box: Box) -> Mapping:
    """The map after which the box has the lower corner that it had."""
    moved = _mapped_box(box, Mapping(matrix=matrix, shift=torch.zeros(box.dim, dtype=torch.float64)))
    shift = [had - has if math.isfinite(had - has) else 0.0 for had, has in zip(box.lower, moved.lower, strict=True)]
    return Mapping(matrix=matrix, shift=torch.tensor(shift, dtype=torch.float64))


def _mapped_box(box: Box, mapping: Mapping) -> Box:
    axes = mapping.matrix.abs().argmax(dim=1).tolist()
    lower, upper = [], []
    for place, axis in enumerate(axes):
        factor, offset = float(mapping.matrix[place, axis]), float(mapping.shift[place])
        ends = sorted((factor * box.lower[axis] + offset, factor * box.upper[axis] + offset))
        lower.append(ends[0])
        upper.append(ends[1])
    return Box(lower, upper, [box.periodic[axis] for axis in axes])
