"""Timing of contenders in turn, in one process: all of them once, then all of them again.

Times are processor times of the process. Every contender steps in one thread and does nothing but compute, so that this
equals the wall time of an idle machine; on a busy one it excludes the time of other programs.
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np

from scvi_codegen.benchmark.cases import STATES, Array
from scvi_codegen.benchmark.contenders.contenders import Contender
from scvi_codegen.benchmark.references import Reference, rms_error
from scvi_codegen.benchmark.work_precision import Point
from scvi_codegen.errors import ScviCodegenError

__all__ = ["PEER_ERRORS", "Measurement", "measure"]

PEER_ERRORS = (ArithmeticError, AttributeError, ImportError, OSError, RuntimeError, TypeError, ValueError)
"""Errors that a peer of an unknown version, or without its compiler, may raise; they are reported."""

PATIENCE = 1.0
"""Seconds per round over all states above which a contender is timed only once."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Measurement:
    """Result of one contender.

    Attributes:
        method, setting, options, compile_seconds: as of the contender.
        seconds: time of one trajectory: median of the repeats for each state, averaged over the states.
        fastest: the same with minima instead of medians.
        error: relative root-mean-square error over the final states.
        repeats: number of rounds timed.
        failure: reason why there is no result, or ``""``.
    """

    method: str
    setting: str
    options: str
    compile_seconds: float
    seconds: float
    fastest: float
    error: float
    repeats: int
    failure: str = ""

    @property
    def point(self) -> Point:
        """Point on the work-precision curve."""
        return Point(seconds=self.seconds, error=self.error)

    @property
    def fastest_point(self) -> Point:
        """Point with the shortest time."""
        return Point(seconds=self.fastest, error=self.error)


@dataclass(slots=True)
class _Record:
    contender: Contender
    seconds: list[list[float]] = field(default_factory=list)
    final: list[Array] = field(default_factory=list)
    failure: str = ""

    def round(self) -> None:
        """Integrate from every state once."""
        taken, final = [], []
        size = self.contender.trajectories
        for index in range(STATES if size == 1 else 1):
            integrate = self.contender.prepare(index)
            began = time.process_time()
            q = integrate()
            taken.append((time.process_time() - began) / size)
            final.append(q)
        self.seconds.append(taken)
        self.final = final

    def wants_more(self) -> bool:
        return not self.failure and (not self.seconds or sum(self.seconds[0]) * self.contender.trajectories < PATIENCE)


def measure(
    contenders: Sequence[Contender],
    reference_of: Callable[[Contender], Reference],
    *,
    repeats: int,
    progress: Callable[[], None] = lambda: None,
) -> list[Measurement]:
    """Time all contenders alternately; a contender that fails is reported with the reason.

    Args:
        contenders: contenders to time.
        reference_of: function that returns the exact final states for a contender.
        repeats: number of rounds, after one that is not timed.
        progress: called after each round of all.
    """
    records = [_Record(contender) for contender in contenders]
    for number in range(repeats + 1):
        for record in records:
            if record.wants_more():
                _attempt(record)
            if number == 0 and record.wants_more():
                record.seconds.clear()  # caches were cold
        progress()
    return [_summary(record, reference_of(record.contender)) for record in records]


def _attempt(record: _Record) -> None:
    try:
        record.round()
    except (*PEER_ERRORS, ScviCodegenError) as error:
        record.failure = f"{type(error).__name__}: {error}"


def _summary(record: _Record, reference: Reference) -> Measurement:
    contender, failed = record.contender, bool(record.failure)
    columns = [] if failed else list(zip(*record.seconds, strict=True))
    error = float("nan") if failed else _error(record.final, reference)
    return Measurement(
        method=contender.method,
        setting=contender.setting,
        options=contender.options,
        compile_seconds=contender.compile_seconds,
        seconds=float("nan") if failed else statistics.fmean(map(statistics.median, columns)),
        fastest=float("nan") if failed else statistics.fmean(map(min, columns)),
        error=error,
        repeats=len(record.seconds),
        failure=record.failure,
    )


def _error(final: list[Array], reference: Reference) -> float:
    """Return the error of one array for each state, or of one for an ensemble that contains all states repeatedly."""
    copies = np.concatenate([np.atleast_2d(q) for q in final]).reshape(-1, *reference.high.shape)
    return float(np.sqrt(np.mean([rms_error(q, reference) ** 2 for q in copies])))
