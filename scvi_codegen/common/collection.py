"""Derivations without Python's search for cyclic garbage, which visits all live objects again and again."""

import functools
import gc
from collections.abc import Callable
from typing import Any, TypeVar, cast

Called = TypeVar("Called", bound=Callable[..., Any])


def without_collection(function: Called) -> Called:
    """Return a function during which cyclic garbage is kept: expressions have no cycles, their references free them.

    A derivation of a robot takes a quarter less processor time, in the same memory.
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
