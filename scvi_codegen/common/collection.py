"""Derivations without Python's search for cyclic garbage, which visits all live objects again and again."""

import functools
import gc
from collections.abc import Callable
from typing import Any, TypeVar, cast

Called = TypeVar("Called", bound=Callable[..., Any])


def without_collection(function: Called) -> Called:
    """Return a function during which cyclic garbage is kept: expressions have no cycles, their references free them.

    Derivations of robots take 9 % (18 degrees of freedom) to 25 % (11) less processor time, in the same memory.
    """

    @functools.wraps(function)
    def derive(*arguments: Any, **keywords: Any) -> Any:
        if not gc.isenabled():
            return function(*arguments, **keywords)
        gc.disable()
        try:
            return function(*arguments, **keywords)
        finally:
            gc.enable()

    return cast(Called, derive)
