"""Comparison of all contenders on one case: compile all, then time them in turn.

Timing of contenders in turn, in one process: all of them once, then all of them again.

Times are processor times of the process. Every contender steps in one thread and does nothing but compute, so that this
equals the wall time of an idle machine; on a busy one it excludes the time of other programs.
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np

from scvi_codegen.benchmark.cases.adaptive import adaptive_case
from scvi_codegen.benchmark.cases.references import Reference, adaptive_reference, reference, rms_error
from scvi_codegen.benchmark.cases.rods import CONSTRAINED_CASES, FORCED_CASES, constrained_contenders
from scvi_codegen.benchmark.cases.rotations import BODIES, FEW_BODIES, ROTATIONS, bodies
from scvi_codegen.benchmark.cases.unforced import STATES, Array, Case, case
from scvi_codegen.benchmark.contenders.ours import adaptive_contenders, our_contenders, our_ensembles
from scvi_codegen.benchmark.contenders.peers import PEERS, missing_module, peer_contenders
from scvi_codegen.benchmark.contenders.taylor import heyoka_ensembles
from scvi_codegen.benchmark.report import CaseResult, Contender, Measurement
from scvi_codegen.benchmark.settings import Plan, ReportActivity
from scvi_codegen.errors import ScviCodegenError
from scvi_codegen.runtime.run.accuracy import without_accuracy_warnings

ENSEMBLES = ("planar-pendulum", "kepler:0.2", "outer-solar-system")
"""Names of the cases that are run as ensembles."""

TRAJECTORIES = 64
Makers = dict[str, Callable[[], Iterable[Contender]]]
"""Functions that return contenders, by name of the peer."""

ReferenceOf = Callable[[Case, Array | None], Reference]
"""Function that returns the final states of a case, from its velocities or from momenta."""


@without_accuracy_warnings()
def run_case(name: str, plan: Plan, report_activity: ReportActivity) -> CaseResult:
    """Compare single trajectories of this package and all peers."""
    return _race_alone(case(name), plan, report_activity)


@without_accuracy_warnings()
def run_forced(name: str, plan: Plan, report_activity: ReportActivity) -> CaseResult:
    """Compare single trajectories with friction and driving forces."""
    return _race_alone(FORCED_CASES[name](), plan, report_activity)


def _race_alone(chosen: Case, plan: Plan, report_activity: ReportActivity) -> CaseResult:
    chosen = replace(chosen, span=chosen.span * plan.share)
    ours = partial(our_contenders, chosen, methods=plan.methods, quick=plan.quick)
    return race(chosen, ours, _makers(chosen, plan), plan, report_activity)


def _makers(chosen: Case, plan: Plan) -> Makers:
    return {peer: partial(peer_contenders, peer, chosen, quick=plan.quick) for peer in plan.peers}


@without_accuracy_warnings()
def run_constrained(name: str, plan: Plan, report_activity: ReportActivity) -> CaseResult:
    """Compare rods as constraints in this package with peers, and this package, in the angles of the rods."""
    both = CONSTRAINED_CASES[name]().shortened(plan.share)
    ours = partial(constrained_contenders, both, quick=plan.quick)
    return race(both.angles, ours, _makers(both.angles, plan), plan, report_activity)


@without_accuracy_warnings()
def run_ensemble(name: str, plan: Plan, report_activity: ReportActivity) -> CaseResult:
    """Compare ensembles of 64 trajectories in one thread; heyoka in its batch mode.

    They start from the eight states of the case repeatedly, so that eight references suffice.
    """
    few = case(name)
    few = replace(few, name=f"ensemble:{name}", span=few.span * plan.share)
    copies = 2 if plan.quick else TRAJECTORIES // STATES
    many = replace(few, q=np.tile(few.q, (copies, 1)), velocity=np.tile(few.velocity, (copies, 1)))
    makers: Makers = {"heyoka": partial(heyoka_ensembles, many, plan.quick)} if "heyoka" in plan.peers else {}
    return race(few, partial(our_ensembles, many, quick=plan.quick), makers, plan, report_activity)


@without_accuracy_warnings()
def run_adaptive(name: str, plan: Plan, report_activity: ReportActivity) -> CaseResult:
    """Compare problems with close encounters in all modes of this package with peers of adaptive step size."""
    chosen = adaptive_case(name)
    peers = ("heyoka", "rebound")
    makers: Makers = {peer: partial(peer_contenders, peer, chosen, quick=True) for peer in peers if peer in plan.peers}
    ours = partial(adaptive_contenders, chosen, quick=plan.quick)
    return race(chosen, ours, makers, plan, report_activity, adaptive_reference)


@without_accuracy_warnings()
def run_rotations(name: str, plan: Plan, report_activity: ReportActivity) -> CaseResult:
    """Compare a rigid body in this package with peers that integrate quaternion and angular velocity."""
    chosen = ROTATIONS[name]()
    chosen = replace(chosen, span=chosen.span * plan.share)

    def ours() -> list[Contender]:
        both = (our_contenders, adaptive_contenders)
        return [contender for make in both for contender in make(chosen, quick=plan.quick)]

    return race(chosen, ours, _makers(chosen, plan), plan, report_activity)


@without_accuracy_warnings()
def run_bodies(plan: Plan, report_activity: ReportActivity) -> CaseResult:
    """Compare many free bodies in this package, in heyoka's batch mode and in one model of MuJoCo."""
    chosen = bodies(FEW_BODIES if plan.quick else BODIES)
    chosen = replace(chosen, span=chosen.span * plan.share)
    makers: Makers = {
        "heyoka": partial(heyoka_ensembles, chosen, plan.quick),
        "mujoco": partial(peer_contenders, "mujoco", chosen, quick=plan.quick),
    }
    makers = {name: make for name, make in makers.items() if name in plan.peers}
    return race(chosen, partial(our_ensembles, chosen, quick=plan.quick), makers, plan, report_activity)


def race(
    chosen: Case,
    ours: Callable[[], list[Contender]],
    makers: Makers,
    plan: Plan,
    report_activity: ReportActivity,
    ends: ReferenceOf = reference,
) -> CaseResult:
    """Time the contenders of this package and of peers in turn, and compare them with the reference."""
    report_activity(f"{chosen.name}: reference")
    exact = ends(chosen, None)
    report_activity(f"{chosen.name}: step sizes")
    skipped: dict[str, str] = {}
    contenders = [*ours(), *_peer_contenders(chosen, makers, skipped, report_activity)]
    report_activity(f"{chosen.name}: {len(contenders)} settings")

    def reference_of(contender: Contender) -> Reference:
        return exact if contender.momenta is None else ends(chosen, contender.momenta[:STATES])

    result = measure(contenders, reference_of, repeats=plan.rounds)
    return CaseResult(
        name=chosen.name,
        span=chosen.span,
        dimension=chosen.dimension,
        accuracy=exact.accuracy,
        measurements=tuple(result),
        skipped=skipped,
    )


def _peer_contenders(
    chosen: Case, makers: Makers, skipped: dict[str, str], report_activity: ReportActivity
) -> Iterator[Contender]:
    for name, make in makers.items():
        missing = missing_module(PEERS[name])
        if missing is not None:
            skipped[name] = f"{missing} is not installed (pip install 'scvi-codegen[bench]')"
        elif not PEERS[name].suits(chosen):
            skipped[name] = "not applicable to this problem"
        else:
            report_activity(f"{chosen.name}: compiling {name}")
            try:
                yield from make()
            except PEER_ERRORS as error:
                skipped[name] = f"{type(error).__name__}: {error}"


PEER_ERRORS = (ArithmeticError, AttributeError, ImportError, OSError, RuntimeError, TypeError, ValueError)
"""Errors that a peer of an unknown version, or without its compiler, may raise; they are reported."""

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
