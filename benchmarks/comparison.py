"""Comparison of all contenders on one case: compile all, then time them in turn, in one process, round after round.

Times are processor times of the process. Every contender steps in one thread and does nothing but compute, so that this
equals the wall time of an idle machine; on a busy one it excludes the time of other programs.
"""

import importlib.util
import statistics
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from benchmarks.cases.references import Reference, reference, rms_error
from benchmarks.cases.unforced import STATES, Array, Case
from benchmarks.contenders.peers import PEERS
from benchmarks.report import ERRORS, CaseResult, Contender, Measurement
from benchmarks.settings import Plan, ReportActivity
from scvi_codegen.common.errors import ScviCodegenError
from scvi_codegen.runs.accuracy.warning_switch import without_accuracy_warnings


@dataclass(frozen=True, slots=True, kw_only=True)
class Race:
    """Contenders on a case.

    Attributes:
        case: case to integrate, already with the span of the plan.
        ours: function that returns the contenders of this package.
        peers: functions of the case and whether the run is quick that return the contenders of a peer, by its name.
        ends: function that returns the final states of a case, from its velocities or from momenta.
        errors: at which all methods are compared.
    """

    case: Case
    ours: Callable[[], Iterable[Contender]]
    peers: Mapping[str, Callable[[Case, bool], Iterable[Contender]]] = field(
        default_factory=lambda: {name: peer.contenders for name, peer in PEERS.items()}
    )
    ends: Callable[[Case, Array | None], Reference] = reference
    errors: tuple[float, ...] = ERRORS


@without_accuracy_warnings()
def run_race(build: Callable[[Plan], Race], plan: Plan, report_activity: ReportActivity) -> CaseResult:
    """Time the contenders of this package and of peers in turn, and compare them with the reference."""
    chosen = build(plan)
    name = chosen.case.name
    report_activity(f"{name}: reference")
    exact = chosen.ends(chosen.case, None)
    report_activity(f"{name}: step sizes")
    skipped: dict[str, str] = {}
    contenders = [*chosen.ours(), *_peer_contenders(chosen, plan, skipped, report_activity)]
    report_activity(f"{name}: {len(contenders)} settings")

    def reference_of(contender: Contender) -> Reference:
        return exact if contender.momenta is None else chosen.ends(chosen.case, contender.momenta[:STATES])

    return CaseResult(
        name=name,
        span=chosen.case.span,
        dimension=chosen.case.dimension,
        reference_accuracy=exact.accuracy,
        measurements=tuple(measure(contenders, reference_of, repeats=plan.rounds)),
        skipped=skipped,
        errors=chosen.errors,
    )


def _peer_contenders(
    chosen: Race, plan: Plan, skipped: dict[str, str], report_activity: ReportActivity
) -> Iterator[Contender]:
    for name in plan.peers:
        if name not in chosen.peers or not PEERS[name].suits(chosen.case):
            continue
        missing = next((each for each in PEERS[name].modules if importlib.util.find_spec(each) is None), None)
        if missing is not None:
            skipped[name] = f"{missing} is not installed ({PEERS[name].source})"
            continue
        report_activity(f"{chosen.case.name}: compiling {name}")
        try:
            yield from chosen.peers[name](chosen.case, plan.quick)
        except PEER_ERRORS as error:
            skipped[name] = f"{type(error).__name__}: {error}"


PEER_ERRORS = (ArithmeticError, AttributeError, ImportError, OSError, RuntimeError, TypeError, ValueError)
"""Errors that a peer of an unknown version, or without its compiler, may raise; they are reported."""

SHORT = 1e-3
"""Seconds of calls that are timed after one of their own, which takes what it needs into the caches."""
PATIENCE = 1.0
"""Seconds per round over all states above which a contender is timed only once."""


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
        for index in range(self.contender.starts if size == 1 else 1):
            if self.is_short():  # as in a loop: code and tables of other contenders have left the caches
                self.contender.prepare(index)()
            integrate = self.contender.prepare(index)
            began = time.process_time()
            q = integrate()
            taken.append((time.process_time() - began) / size)
            final.append(q() if callable(q) else q)
        self.seconds.append(taken)
        self.final = final

    def is_short(self) -> bool:
        return bool(self.seconds) and max(self.seconds[-1]) * self.contender.trajectories < SHORT

    def wants_more(self) -> bool:
        return not self.failure and (not self.seconds or sum(self.seconds[0]) * self.contender.trajectories < PATIENCE)


def measure(
    contenders: Sequence[Contender], reference_of: Callable[[Contender], Reference], *, repeats: int
) -> list[Measurement]:
    """Time all contenders alternately; a contender that fails is reported with the reason.

    Args:
        contenders: contenders to time.
        reference_of: function that returns the exact final states for a contender.
        repeats: number of rounds, after one that is not timed.
    """
    records = [_Record(contender) for contender in contenders]
    for number in range(repeats + 1):
        for record in records:
            if record.wants_more():
                try:
                    record.round()
                except (*PEER_ERRORS, ScviCodegenError) as error:
                    record.failure = f"{type(error).__name__}: {error}"
            if number == 0 and record.wants_more():
                record.seconds.clear()  # caches were cold
    return [_summary(record, reference_of) for record in records]


def _summary(record: _Record, reference_of: Callable[[Contender], Reference]) -> Measurement:
    contender, failed, error = record.contender, bool(record.failure), float("nan")
    columns = [] if failed else list(zip(*record.seconds, strict=True))
    if not failed:
        own = contender.error
        error = _error(record.final, reference_of(contender)) if own is None else own(record.final[0])
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
    copies = np.concatenate([np.atleast_2d(q) for q in final]).reshape(-1, *reference.positions.shape)
    return float(np.sqrt(np.mean([rms_error(q, reference) ** 2 for q in copies])))
