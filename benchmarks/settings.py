"""Settings of a benchmark, and processor times of functions."""

import os
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TypeVar

from benchmarks.contenders.peers import PEERS
from scvi_codegen.common.errors import StateError
from scvi_codegen.methods.method import Method

Result = TypeVar("Result")

QUICK_SHARE = 0.05
QUICK_REPEATS = 2

ReportActivity = Callable[[str], None]
"""Function that is called with a description of each activity."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Plan:
    """Settings of a benchmark.

    Attributes:
        peers: names of the peers.
        repeats: number of timed rounds.
        quick: a twentieth of the span and few settings, as a smoke test.
        methods: methods of this package; by default SVI(8).
    """

    peers: tuple[str, ...] = tuple(PEERS)
    repeats: int = 5
    quick: bool = False
    methods: tuple[Method, ...] = ()

    def __post_init__(self) -> None:
        for name in self.peers:
            if name not in PEERS:
                raise StateError(f"there is no peer '{name}'. Known: {', '.join(PEERS)}")
        if self.repeats < 1:
            raise StateError(f"repeats must be at least 1, not {self.repeats}")

    @property
    def rounds(self) -> int:
        """Number of timed rounds."""
        return min(self.repeats, QUICK_REPEATS) if self.quick else self.repeats

    @property
    def share(self) -> float:
        """Part of each span that is integrated."""
        return QUICK_SHARE if self.quick else 1.0


def timed(work: Callable[[], Result]) -> tuple[float, Result]:
    """Return the processor seconds of a call, and its result."""
    began = time.process_time()
    result = work()
    return time.process_time() - began, result


@contextmanager
def set_variable(name: str, value: str) -> Iterator[None]:
    """Set an environment variable, and restore it afterwards."""
    before = os.environ.get(name)
    os.environ[name] = value
    try:
        yield
    finally:
        del os.environ[name]
        if before is not None:
            os.environ[name] = before
