"""Geometries of frames that are seen again, kept up to a number of bytes."""

from collections.abc import Callable

from cconv.models.model import FrameGeometry
from cconv.tasks.samples import Sample


class GeometryCache:
    """Builds the geometry of a sample, and keeps those that come first until the memory is used up.

    Samples come round once an epoch in a new order, so an eviction would only throw out what comes next.

    Args:
        build: Inputs of a frame to its geometry.
        max_bytes: Memory to use at most.
    """

    def __init__(self, build: Callable[..., FrameGeometry], max_bytes: int):
        self._build = build
        self._bytes_left = max_bytes
        self._kept: dict[tuple[str, int], FrameGeometry] = {}

    def __call__(self, sample: Sample) -> FrameGeometry:
        """Geometry of `sample`."""
        key = (sample.trajectory, sample.frame)
        if key in self._kept:
            return self._kept[key]
        geometry = self._build(sample.inputs)
        if geometry.nbytes <= self._bytes_left:
            self._kept[key] = geometry
            self._bytes_left -= geometry.nbytes
        return geometry
