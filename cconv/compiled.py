"""Compiled functions whose cache on disk may be missing, damaged or not writable: then they are compiled again."""

from collections.abc import Callable
from typing import Any

from numba import njit
from numba.core.caching import NullCache


def compile_cached(**options: Any) -> Callable:
    """Compile functions with numba and `options`, and keep the machine code on disk where that is possible.

    numba fails where a file of its cache holds garbage or cannot be written, and where there is no place for a cache.
    A cache saves seconds and decides nothing, so each of these means only that a function is compiled once more.
    NUMBA_CACHE_DIR names another place for it.
    """

    def decorate(function: Callable) -> Callable:
        compiled = njit(**options)(function)
        try:
            compiled.enable_caching()
        except RuntimeError:  # numba found no folder that it can write to
            return compiled
        compiled._cache = _ForgivingCache(compiled._cache)
        return compiled

    return decorate


class _ForgivingCache:
    """numba's cache of a function, taken for empty where it cannot be read or written.

    Args:
        cache: The cache.
    """

    def __init__(self, cache: Any):
        self._cache = cache

    def __getattr__(self, name: str) -> Any:
        return getattr(self._cache, name)

    def load_overload(self, signature: Any, target: Any) -> Any:
        """The machine code for a signature; None if there is none, or none that can be read."""
        try:
            return self._cache.load_overload(signature, target)
        except Exception:  # whatever unpickling garbage raises
            self._begin_anew()
            return None

    def save_overload(self, signature: Any, result: Any) -> None:
        """Keep the machine code for a signature, if that is possible."""
        try:
            self._cache.save_overload(signature, result)
        except Exception:  # an index of garbage is read first
            self._begin_anew()

    def _begin_anew(self) -> None:
        try:
            self._cache.flush()
        except OSError:
            self._cache = NullCache()
