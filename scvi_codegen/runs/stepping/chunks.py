"""Loop that advances runs in chunks of bounded duration; the only one that looks at the clock."""

import time
from collections.abc import Callable

CALL_SECONDS = 0.1
"""Target duration of a C call in seconds; bounds the delay of Ctrl-C and of ``progress``."""
LONGEST_CHUNK = 2.0**62


def drive(
    advance: Callable[[int], int],
    steps: float,
    *,
    first: int = 1,
    most: float = LONGEST_CHUNK,
    growth: float = 2.0,
    seconds: float | None = None,
    ended: Callable[[], bool],
    progress: Callable[[int], None] | None = None,
) -> int:
    """Take steps in chunks of bounded duration, so that Python regains control regularly; return the size of the next.

    Args:
        advance: function that takes a number of steps and returns how many it took.
        steps: number of steps, possibly infinite.
        first, most: steps of the first chunk, and largest chunk size.
        growth: largest ratio of successive chunk sizes.
        seconds: target duration of a chunk, by default ``CALL_SECONDS``.
        ended: function that returns whether the run has ended; called before each chunk.
        progress: called with the number of steps after each chunk.
    """
    done, size, target = 0, first, CALL_SECONDS if seconds is None else seconds
    while done < steps and not ended():
        began, count = time.perf_counter(), int(min(size, steps - done))
        done += advance(count)
        if progress is not None:
            progress(done)
        if count == size:
            faster = min(growth, target / max(time.perf_counter() - began, 1e-6))
            size = max(1, int(min(size * faster, most)))
    return size
