"""A cache of the geometries of frames, with a limited memory."""

from collections.abc import Callable

from cconv.models.model import FrameGeometry
from cconv.tasks.samples import Sample


class GeometryCache:
    """A cache that builds the geometry of a sample, and keeps the first ones until its memory is full.

    Nothing is evicted, because every sample returns once in each epoch: an eviction would only replace one useful
    geometry by another.

    Args:
        build: Function from the inputs of a frame to its geometry.
        max_bytes: Largest memory to use.
    """

    def __init__(self, build: Callable[..., FrameGeometry], max_bytes: int):
        self._build = build
        self._bytes_left = max_bytes
        self._kept: dict[tuple[str, int], FrameGeometry] = {}

    def __call__(self, sample: Sample) -> FrameGeometry:
        """Return the geometry of a sample."""
        key = (sample.trajectory, sample.frame)
        if key in self._kept:
            return self._kept[key]
        geometry = self._build(sample.inputs)
        if geometry.nbytes <= self._bytes_left:
            self._kept[key] = geometry
            self._bytes_left -= geometry.nbytes
        return geometry
