"""Find the smallest, fastest continuous-convolution network that is accurate and stable enough for a fluid scene."""

from importlib import import_module
from typing import Any

__version__ = "0.1.0"

_HOMES = {
    "Box": "cconv.domain",
    "Dataset": "cconv.data.dataset",
    "Edges": "cconv.neighbors",
    "ParticleArrays": "cconv.data.arrays",
    "SceneFacts": "cconv.data.arrays",
    "fit_closed_form": "cconv.models.closed_form",
    "load_model": "cconv.models.checkpoint",
    "open_dataset": "cconv.data.dataset",
    "radius_graph": "cconv.neighbors",
    "write_dataset": "cconv.data.arrays",
}
__all__ = list(_HOMES)


def __getattr__(name: str) -> Any:
    # Loaded when first used: torch takes seconds, and `cconv --help` needs none of it.
    if name in _HOMES:
        return getattr(import_module(_HOMES[name]), name)
    if name in ("networks", "nn", "rollout", "sph"):
        return import_module(f"cconv.{name}")
    raise AttributeError(f"module 'cconv' has no attribute {name!r}")
