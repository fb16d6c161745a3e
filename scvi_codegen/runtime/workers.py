"""Work on each of many trajectories, shared between threads: C runs without Python's lock."""

from __future__ import annotations

import os
import threading
from collections.abc import Callable
from concurrent.futures import FIRST_EXCEPTION, ThreadPoolExecutor, wait

from scvi_codegen.given.counts import checked_count

__all__ = ["MOST_PIECES", "PROGRESS_SECONDS", "Heed", "run_each", "workers_of"]

PROGRESS_SECONDS = 0.1
MOST_PIECES = 4096
"""That threads take one after the other: waiting for a million would take longer than many of them."""

Heed = Callable[[int], None]
"""What long work calls now and then, with any number: it raises where another piece of work failed."""


class _Stopped(Exception):  # noqa: N818  (a wish, not an error)
    """Another trajectory was interrupted, and so is this one."""


def workers_of(threads: int | None) -> int:
    """The number of workers, one a core where none is given."""
    given = 0 if threads is None else checked_count(threads, "threads", least=1)
    return given or os.cpu_count() or 1


def run_each(
    count: int,
    work: Callable[[int, Heed], None],
    *,
    progress: Callable[[int], None] | None,
    threads: int | None,
) -> None:
    """Call ``work(j, heed)`` for j < count; what ``progress`` or ``work`` raises stops all within moments.

    Args:
        progress: called now and then with how many are done.
        threads: workers, by default one a core.
    """
    workers, stop = workers_of(threads), threading.Event()
    pieces, done = min(count, MOST_PIECES), 0

    def heed(_: int) -> None:
        if stop.is_set():
            raise _Stopped

    def take(piece: int) -> int:
        each = range(piece, count, pieces)
        for j in each:
            heed(j)
            work(j, heed)
        return len(each)

    with ThreadPoolExecutor(workers) as pool:
        try:
            pending = {pool.submit(take, piece) for piece in range(pieces)}
            while pending:
                finished, pending = wait(pending, PROGRESS_SECONDS, FIRST_EXCEPTION)
                done += sum(future.result() for future in finished)
                if progress is not None:
                    progress(done)
        finally:
            stop.set()
            pool.shutdown(cancel_futures=True)
