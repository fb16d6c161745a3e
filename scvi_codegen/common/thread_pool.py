"""Thread pool for work on each of many trajectories; C runs without the GIL."""

import os
import threading
from collections.abc import Callable
from concurrent.futures import FIRST_EXCEPTION, ThreadPoolExecutor, wait

from scvi_codegen.common.validation import checked_count

PROGRESS_SECONDS = 0.1

StopCheck = Callable[[int], None]
"""Callback for long work, with any number: it raises if another job failed."""


class _Stopped(Exception):  # noqa: N818  (a signal, not an error)
    """Signal that stops a job after another one failed or was interrupted."""


def run_jobs(
    count: int, work: Callable[[int, StopCheck], None], *, progress: Callable[[int], None] | None, threads: int | None
) -> None:
    """Call ``work(j, check_stop)`` for j < count; an exception of ``progress`` or ``work`` stops all jobs promptly.

    ``progress`` is called with the number of completed jobs; by default there is one thread per core.
    """
    argument = 0 if threads is None else checked_count(threads, "threads", least=1)
    workers, stop = min(count, argument or os.cpu_count() or 1), threading.Event()
    jobs, completed = iter(range(count)), [0] * workers

    def check_stop(_: int) -> None:
        if stop.is_set():
            raise _Stopped

    def take(worker: int) -> None:
        for j in jobs:  # of all workers
            check_stop(j)
            work(j, check_stop)
            completed[worker] += 1

    with ThreadPoolExecutor(max(1, workers)) as pool:
        try:
            pending = {pool.submit(take, worker) for worker in range(workers)}
            while pending:
                finished, pending = wait(pending, PROGRESS_SECONDS, FIRST_EXCEPTION)
                for future in finished:
                    future.result()
                if progress is not None:
                    progress(sum(completed))
        finally:
            stop.set()
            pool.shutdown(cancel_futures=True)
