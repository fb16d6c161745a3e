"""Work bounded by a number of function calls: the same on a quick, a slow and a busy machine, unlike seconds."""

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType


class TooMuchWorkError(BaseException):
    """Base exception, so that code under test does not catch it."""


@contextmanager
def visited() -> Iterator[set[tuple[str, str]]]:
    """Collect the functions of Python that are called, as pairs of file and name."""
    functions: set[tuple[str, str]] = set()

    def look(frame: FrameType, event: str, argument: object) -> None:
        if event == "call":
            functions.add((frame.f_code.co_filename, frame.f_code.co_name))

    sys.setprofile(look)
    try:
        yield functions
    finally:
        sys.setprofile(None)


@contextmanager
def at_most(calls: int) -> Iterator[None]:
    """Raise :class:`TooMuchWorkError` where more functions, of Python or C, are called."""
    count = 0

    def look(frame: FrameType, event: str, argument: object) -> None:
        nonlocal count
        count += event in ("call", "c_call")
        if count > calls:
            raise TooMuchWorkError(f"more than {calls} function calls")

    sys.setprofile(look)
    try:
        yield
    finally:
        sys.setprofile(None)
