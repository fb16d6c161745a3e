"""Memory of this machine, and errors for states that exceed it; the system kills larger processes without a message."""

import math
import os
from contextlib import suppress
from functools import cache
from pathlib import Path

from scvi_codegen.common.errors import StepFailedError

TOO_MANY_STATES = "too many states"
"""Status of a run that ended because its states exceed the memory."""
COPIES = 3
"""Copies of the states that exist at once: chunks, the arrays that join them, and quantities of these."""
CGROUP_LIMIT = Path("/sys/fs/cgroup/memory.max")
"""File with the memory limit of a Linux control group (container)."""


@cache  # runs ask in each chunk
def usable_memory() -> float:
    """Return the bytes of memory available to this process; infinity if the system does not report them."""
    result = [math.inf]
    with suppress(AttributeError, OSError, ValueError):
        result.append(float(os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")))
    with suppress(OSError, ValueError):
        result.append(float(CGROUP_LIMIT.read_text()))
    return min(result)


def room_for_states() -> float:
    """Return the bytes that the saved states of a run or of an ensemble may occupy."""
    return usable_memory() / COPIES


def too_many_states(count: int, step: int, t: float) -> StepFailedError:
    """Return the error that ends a run with ``count`` saved states after a step, at time t."""
    message = (
        f"the {count} states of the run up to t = {t:g} fill the memory. Save fewer of them (t_eval, save_every), only "
        "results of them (observe), or record the run in a folder (record_run, -o NAME.run)"
    )
    return StepFailedError(message, status=TOO_MANY_STATES, step=step, t=t, residual=math.nan)
