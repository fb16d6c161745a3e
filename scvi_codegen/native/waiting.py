"""Announcement of derivations and compilations that take longer than a second.

They are announced on stderr where that is a terminal, and always by the logger ``scvi_codegen`` at level INFO.
"""

from __future__ import annotations

import logging
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar

__all__ = ["tell", "told_to", "waiting_for"]

PATIENCE_SECONDS = 1.0
LOGGER = logging.getLogger("scvi_codegen")


def _print(what: str) -> None:
    """A line on stderr, be it a terminal or a file."""
    if sys.stderr is not None:
        print(f"scvi-codegen: {what} ...", file=sys.stderr, flush=True)


def _tell_the_terminal(what: str) -> None:
    """A line where a person waits for it."""
    if sys.stderr is not None and sys.stderr.isatty():
        _print(what)


_listener: ContextVar[Callable[[str], None] | None] = ContextVar("listener", default=None)


def tell(what: str) -> None:
    """Say it now, also where nobody looks until the work is done: how long that takes, say."""
    (_listener.get() or _print)(what)


@contextmanager
def waiting_for(what: str) -> Iterator[None]:
    """Announce what is being done if it takes longer than a second."""
    listener = _listener.get() or _tell_the_terminal

    def announce() -> None:
        LOGGER.info(what)
        listener(what)

    timer = threading.Timer(PATIENCE_SECONDS, announce)
    timer.daemon = True
    timer.start()
    try:
        yield
    finally:
        timer.cancel()


@contextmanager
def told_to(listener: Callable[[str], None]) -> Iterator[None]:
    """Have it said to a function, from a thread of its own, instead of on a terminal's stderr."""
    token = _listener.set(listener)
    try:
        yield
    finally:
        _listener.reset(token)
