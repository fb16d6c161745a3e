"""Values that are made when they are first needed."""

from collections.abc import Callable
from functools import partial
from typing import Generic, TypeVar

Value = TypeVar("Value")


class Once(Generic[Value]):
    """Function without arguments whose value is made at the first call and kept; a pickle makes it again.

    Attributes:
        make: function without arguments that makes the value.
    """

    def __init__(self, make: Callable[[], Value]) -> None:
        self.make = make
        self._value: list[Value] = []

    def __call__(self) -> Value:
        """Return the value."""
        if not self._value:
            self._value.append(self.make())
        return self._value[0]

    def __reduce__(self) -> tuple[object, ...]:
        return Once, (self.make,)


def constantly(value: Value) -> Callable[[], Value]:
    """Return a function that returns a value, and can be pickled."""
    return partial(_itself, value)


def _itself(value: Value) -> Value:
    return value
