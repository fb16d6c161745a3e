"""Switch of the accuracy warnings, for code that takes large steps on purpose."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from functools import wraps
from typing import Any, TypeVar, cast

from scvi_codegen.errors import AccuracyWarning, warn

Check = TypeVar("Check", bound=Callable[..., Any])

_warnings_enabled: ContextVar[bool] = ContextVar("accuracy warnings are wanted", default=True)


@contextmanager
def without_accuracy_warnings() -> Iterator[None]:
    """Suppress accuracy warnings within a ``with`` block or a decorated function that takes large steps on purpose."""
    token = _warnings_enabled.set(False)
    try:
        yield
    finally:
        _warnings_enabled.reset(token)


def check_of_finished_run(check: Check) -> Check:
    """Let a check of a finished run fail with a warning: the run must not be lost. Warnings as errors are raised."""

    @wraps(check)
    def checked(*arguments: Any, **named: Any) -> Any:
        try:
            return check(*arguments, **named)
        except Warning:
            raise
        except Exception as error:  # noqa: BLE001  (whatever fails, the run is complete)
            message = (
                f"the accuracy of the run was not checked ({type(error).__name__}: {error}); its states are complete"
            )
            warn(message, AccuracyWarning)

    return cast(Check, checked)


def warnings_wanted() -> bool:
    """Return whether accuracy warnings are wanted: not inside :func:`without_accuracy_warnings`."""
    return _warnings_enabled.get()
