"""Rollouts: a model's answers turned into the next frame, again and again.

The package can be called: `cconv.rollout(model, start, scene)` is `cconv.rollout.rollout.rollout`, so that the public
function and the folder of what belongs to it have the same name.
"""

import sys
from types import ModuleType
from typing import Any


class _Callable(ModuleType):
    def __call__(self, *args: Any, **keywords: Any) -> Any:
        from cconv.rollout.rollout import rollout

        return rollout(*args, **keywords)


sys.modules[__name__].__class__ = _Callable
