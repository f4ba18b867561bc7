"""The checker of annotations that the tests put around the functions of the numeric modules (pyproject.toml)."""

from collections.abc import Callable
from typing import Any

from beartype import BeartypeConf, beartype

_check = beartype(conf=BeartypeConf(is_pep484_tower=True))  # a whole number is a real one


def checked(function: Callable) -> Callable:
    """Check arguments and result together, once a call has returned.

    jaxtyping asks twice for each call: with the arguments alone before it, where nothing is said of a result, and with
    the result after it. Only the second is answered, so that functions refuse what does not fit by themselves, with
    their own message, as they do for users. What they accept must agree with the annotations.
    """
    return function if function.__annotations__.get("return", Any) is Any else _check(function)
