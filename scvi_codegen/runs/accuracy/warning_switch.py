"""Switch of the accuracy warnings, for code that takes large steps on purpose."""

from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar

from scvi_codegen.common.errors import AccuracyWarning, warn

_warnings_enabled: ContextVar[bool] = ContextVar("accuracy warnings are wanted", default=True)
warnings_wanted = _warnings_enabled.get
"""Function that returns whether accuracy warnings are wanted: not inside :func:`without_accuracy_warnings`."""


@contextmanager
def without_accuracy_warnings() -> Iterator[None]:
    """Suppress accuracy warnings within a ``with`` block or a decorated function that takes large steps on purpose."""
    token = _warnings_enabled.set(False)
    try:
        yield
    finally:
        _warnings_enabled.reset(token)


def warn_of_failed_check(error: Exception) -> None:
    """Issue a warning instead of the error of a check of a finished run, which must not be lost.

    Raises:
        Warning: if ``error`` is one, of filters that raise warnings.
    """
    if isinstance(error, Warning):
        raise error
    message = f"the accuracy of the run was not checked ({type(error).__name__}: {error}); its states are complete"
    warn(message, AccuracyWarning)
