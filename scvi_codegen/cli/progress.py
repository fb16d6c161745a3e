"""Progress bar of a run, and handling of SIGINT and SIGTERM."""

from __future__ import annotations

import contextlib
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from types import FrameType

import click

from scvi_codegen.cli.command_group import is_quiet

BAR_LENGTH = 1000
"""Length of the progress bar of a run whose number of steps is not known in advance."""


@contextlib.contextmanager
def interruptions() -> Iterator[list[int]]:
    """Record the first SIGINT or SIGTERM in a list instead of ending the process; a second one acts as usual."""
    caught: list[int] = []
    if threading.current_thread() is not threading.main_thread():
        yield caught  # only the main thread may handle signals
        return
    signals = (signal.SIGINT, signal.SIGTERM)
    before = {int(number): signal.getsignal(number) for number in signals}

    def note(number: int, frame: FrameType | None) -> None:
        caught.append(number)
        signal.signal(number, before[number])

    try:
        for number in signals:
            signal.signal(number, note)
        yield caught
    finally:
        for number in signals:
            signal.signal(number, before[number])


@contextlib.contextmanager
def progress_bar(steps: int) -> Iterator[Callable[[int], None]]:
    """Show a bar on stderr if that is a terminal; the function it yields takes the number of completed steps."""
    if not sys.stderr.isatty() or steps == 0 or is_quiet():
        yield lambda done: None
        return
    with click.progressbar(length=steps, label="integrating", file=sys.stderr) as bar:
        yield lambda done: bar.update(done - bar.pos)
