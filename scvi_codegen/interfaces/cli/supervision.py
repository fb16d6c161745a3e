"""Supervision of a run: check of the memory that it needs, progress bar, and handling of SIGINT and SIGTERM."""

import contextlib
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from types import FrameType
from typing import Any

import click

from scvi_codegen.codegen.native.capacity import COPIES, room_for_states
from scvi_codegen.common.errors import StateError
from scvi_codegen.interfaces.cli.command_group import is_quiet
from scvi_codegen.interfaces.models.model import Model


def check_memory(model: Model, trajectories: int = 1) -> None:
    """Reject a run of a known number of steps whose saved states do not fit into memory; others end with them."""
    steps = 0 if model.ends_at_time else model.step_count
    saved = steps // model.save_every + 1
    bytes_of_state = 16 * model.dimension * trajectories + 12  # q and p of each; time and iterations
    room = room_for_states() / bytes_of_state
    if saved <= room:
        return
    states, remedies = f"{saved} states", list[str]()
    if room >= 2:
        remedies.append(f"save fewer (--save-every {-(-steps // int(room - 1))})")
    if trajectories == 1:
        remedies.append("record the run in a folder (-o NAME.run)")
    else:
        states += f" of each of {trajectories} trajectories"
    needed = f"{COPIES * bytes_of_state * saved / 1e9:.3g} GB of memory"
    raise StateError(f"{states} need {needed}: {' or '.join(remedies or ['reduce the number of steps'])}")


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
def progress_bar(steps: int, label: str = "integrating") -> Iterator[Callable[..., Any]]:
    """Show a bar on stderr if that is a terminal and not ``--quiet``.

    Yields a function of the number of completed steps, and of a text that is shown beside the bar; it returns whether
    there is a bar.
    """
    if not sys.stderr.isatty() or steps == 0 or is_quiet():
        yield lambda done, text="": False
        return

    def show(done: int, text: str = "") -> bool:
        bar.current_item = text
        bar.update(done - bar.pos)
        bar.render_progress()
        return True

    with click.progressbar(length=steps, label=label, file=sys.stderr, item_show_func=lambda text: text) as bar:
        yield show
