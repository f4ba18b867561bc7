"""A cache of the geometries of frames, with a limited memory."""

from collections.abc import Callable

from cconv.data.window import Origin
from cconv.models.model import FrameGeometry, join_geometries
from cconv.tasks.inputs import Inputs
from cconv.tasks.samples import Sample


class GeometryCache:
    """A cache that builds the geometries of the frames of samples, and keeps the first ones until its memory is full.

    Nothing is evicted, because every sample returns once in each epoch: an eviction would only replace one useful
    geometry by another. Those of several frames in one graph are kept one by one, because batches do not return.

    Args:
        build: Function from the inputs of a frame, or of several, to its geometry.
        max_bytes: Largest memory to use; with 0 nothing is kept.
    """

    def __init__(self, build: Callable[[Inputs], FrameGeometry], max_bytes: int):
        self._build = build
        self._keeps, self._bytes_left = max_bytes > 0, max_bytes
        self._kept: dict[Origin, FrameGeometry] = {}

    def __call__(self, sample: Sample) -> FrameGeometry:
        """Return the geometry of a sample."""
        if not self._keeps:
            return self._build(sample.inputs)
        parts = zip(sample.origins, sample.inputs.separated(), strict=True)
        return join_geometries([self._of_frame(origin, inputs) for origin, inputs in parts])

    def _of_frame(self, origin: Origin, inputs: Inputs) -> FrameGeometry:
        if origin in self._kept:
            return self._kept[origin]
        geometry = self._build(inputs)
        if geometry.nbytes <= self._bytes_left:
            self._kept[origin] = geometry
            self._bytes_left -= geometry.nbytes
        return geometry
