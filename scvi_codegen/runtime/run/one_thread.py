"""Lock of a run: a second thread that enters raises an error, because C functions modify one struct."""

import functools
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, TypeVar, cast

from scvi_codegen.errors import StateError

Called = TypeVar("Called", bound=Callable[..., Any])


def in_use() -> StateError:
    """Return the error for a second thread."""
    return StateError(
        "this run is in use by another thread: only one thread may use a run at a time. Start a run for each thread "
        "(stepper.start(...), copy.copy(run)); the stepper may be shared"
    )


class OneThread:
    """Base class of runs with a re-entrant lock, so that callbacks in the owning thread may call methods."""

    def __init__(self) -> None:
        self._lock = threading.RLock()

    @contextmanager
    def alone(self) -> Iterator[None]:
        """Lock the run for several calls.

        Raises:
            StateError: if another thread has locked it.
        """
        if not self._lock.acquire(blocking=False):
            raise in_use()
        try:
            yield
        finally:
            self._lock.release()


def alone(method: Called) -> Called:
    """Decorate a method to lock its run; the method raises as :meth:`OneThread.alone`."""

    @functools.wraps(method)
    def locked(self: Any, *arguments: Any, **keywords: Any) -> Any:
        lock = self._lock
        if not lock.acquire(False):
            raise in_use()
        try:
            return method(self, *arguments, **keywords)
        finally:
            lock.release()

    return cast(Called, locked)
