"""Announcement of derivations and compilations that take longer than a second.

They are announced by the logger ``scvi_codegen`` at level INFO, and by a line on stderr unless that logger passes on
messages of this level, or has a higher level, as by ``logging.getLogger("scvi_codegen").setLevel("WARNING")``.
"""

import logging
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar

PATIENCE_SECONDS = 1.0
LOGGER = logging.getLogger("scvi_codegen")


def _print(message: str) -> None:
    """Print a line on stderr, also if it is a file."""
    if sys.stderr is not None:
        print(f"scvi-codegen: {message} ...", file=sys.stderr, flush=True)


def _print_unless_logged(message: str) -> None:
    if not LOGGER.isEnabledFor(logging.INFO) and LOGGER.level <= logging.INFO:
        _print(message)


_listener: ContextVar[Callable[[str], None] | None] = ContextVar("listener", default=None)


def tell(message: str) -> None:
    """Announce a message now, e.g. the expected duration of a computation."""
    (_listener.get() or _print)(message)


@contextmanager
def announced(message: str) -> Iterator[None]:
    """Announce a computation if it takes longer than a second."""
    listener = _listener.get() or _print_unless_logged

    def announce() -> None:
        LOGGER.info(message)
        listener(message)

    timer = threading.Timer(PATIENCE_SECONDS, announce)
    timer.daemon = True
    timer.start()
    try:
        yield
    finally:
        timer.cancel()


@contextmanager
def announce_to(listener: Callable[[str], None]) -> Iterator[None]:
    """Pass announcements to a function, from a separate thread, instead of stderr."""
    token = _listener.set(listener)
    try:
        yield
    finally:
        _listener.reset(token)
