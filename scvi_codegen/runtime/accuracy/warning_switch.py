"""Switch of the accuracy warnings, for code that takes large steps on purpose."""

from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar

_warnings_enabled: ContextVar[bool] = ContextVar("accuracy warnings are wanted", default=True)


@contextmanager
def without_accuracy_warnings() -> Iterator[None]:
    """Suppress accuracy warnings within a ``with`` block or a decorated function that takes large steps on purpose."""
    token = _warnings_enabled.set(False)
    try:
        yield
    finally:
        _warnings_enabled.reset(token)


def warnings_wanted() -> bool:
    """Return whether accuracy warnings are wanted: not inside :func:`without_accuracy_warnings`."""
    return _warnings_enabled.get()
