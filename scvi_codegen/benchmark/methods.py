"""Benchmark of energy drift over ten million steps of the Kepler problem; heyoka on the same spans.

Benchmark of SVI and explicit compositions: Stoermer-Verlet (order 2), Kahan-Li and Sofroniou-Spaletta (8 and 10).

Every method runs with smaller and smaller steps, over a tenth of the span of each case (in longer spans round-off alone
exceeds the smallest error asked for), until the error is small enough or the run takes too long. Errors that a method
does not reach are extrapolated by its order and marked.

Tables 6 and 7 of the paper: SVI, a symplectic Runge-Kutta method (Gauss) with fewer stages, and collocation.

Step sizes, spans, initial states and tolerance (1e-14 for the largest change of a position or momentum) are the
paper's; the quadrature, where it is not stated for an SVI of degree s, has s Gauss points. The claim of the paper: SVI
is cheaper and more accurate than the Runge-Kutta method.
"""

from __future__ import annotations

import importlib.util
import math
import statistics
import time
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from scvi_codegen.benchmark.cases.references import Reference, reference, rms_error
from scvi_codegen.benchmark.cases.unforced import Array, Case, case
from scvi_codegen.benchmark.contenders.ours import momenta_of
from scvi_codegen.benchmark.contenders.taylor import heyoka_states
from scvi_codegen.benchmark.report import Point, ResultTable, time_at
from scvi_codegen.benchmark.settings import Plan, ReportActivity
from scvi_codegen.compiler import compile_stepper
from scvi_codegen.errors import StepFailedError
from scvi_codegen.methods import Gauss, SpectralCollocation, StoermerVerlet
from scvi_codegen.methods.composition import Composition
from scvi_codegen.methods.galerkin import SVI
from scvi_codegen.methods.method import Method
from scvi_codegen.native.options import SolverOptions
from scvi_codegen.runtime.core.stepper import Stepper
from scvi_codegen.runtime.run.accuracy import without_accuracy_warnings

DRIFTS = {"kepler:0.2": (0.5, 0.35, 0.2), "kepler:0.5": (0.2, 0.15, 0.1)}
"""Three step sizes for each case, from the largest without a visible truncation error down."""

STEPS, QUICK_STEPS = 10_000_000, 20_000
SAMPLES = 2000
BLOCKS = 20


@without_accuracy_warnings()
def run_drift(plan: Plan, report_activity: ReportActivity) -> ResultTable:
    """Measure all cases at all step sizes, with SVI(8) and heyoka at its default tolerance."""
    steps = QUICK_STEPS if plan.quick else STEPS
    with_heyoka = "heyoka" in plan.peers and importlib.util.find_spec("heyoka") is not None
    rows = []
    for name, sizes in DRIFTS.items():
        for h in sizes:
            report_activity(f"drift: {name}, h = {h:g}, {steps} steps")
            rows += drift_rows(case(name), h, steps, with_heyoka=with_heyoka)
    formats = {"case": "", "method": "", "h": "g", "span": ".0f", "seconds": ".2f", "at_the_end": ".1e"}
    return ResultTable(
        name="drift",
        title=f"relative energy error over {steps} steps",
        columns=formats | {"largest": ".1e", "drift": ".1e", "uncertainty": ".1e"},
        rows=tuple(rows),
        remarks=(
            "drift: slope of the fitted line times the length of the run. uncertainty: its standard error, from the",
            f"variance of the gains over {BLOCKS} blocks, since round-off makes the energy a random walk.",
        ),
    )


def drift_rows(chosen: Case, h: float, steps: int, *, with_heyoka: bool) -> list[dict[str, Any]]:
    """Return one row per method, from the first state of a case."""
    stepper = compile_stepper(chosen.system, SVI(8))
    q, p = chosen.q[0], stepper.momentum(chosen.q[0], chosen.velocity[0])
    save_every = max(1, steps // SAMPLES)
    began = time.process_time()
    run = stepper.integrate(q, p, h=h, steps=steps, save_every=save_every)
    result = [("scvi-codegen", h, time.process_time() - began, run.q, run.p)]
    if with_heyoka:
        began = time.process_time()
        states = heyoka_states(chosen, np.linspace(0.0, h * steps, steps // save_every + 1))
        half = chosen.dimension
        result.append(("heyoka", float("nan"), time.process_time() - began, states[:, :half], states[:, half:]))
    return [
        {"case": chosen.name, "method": method, "h": size, "span": h * steps, "seconds": seconds}
        | _energy_entries(stepper, q, p)
        for method, size, seconds, q, p in result
    ]


def _energy_entries(stepper: Stepper, q: Array, p: Array) -> dict[str, float]:
    energy = stepper.energy(q, p)
    error = (energy - energy[0]) / abs(energy[0])
    drift, uncertainty = fitted_rate(error)
    largest = float(np.abs(error).max())
    return {"at_the_end": float(error[-1]), "largest": largest, "drift": drift, "uncertainty": uncertainty}


def fitted_rate(error: Array) -> tuple[float, float]:
    """Return the slope of a line fitted to equidistant samples, times their length, and its standard error.

    Round-off makes the energy a random walk, so the residuals of the fit are correlated and the usual error is too
    small. The increments of the walk are independent: the error is estimated from the variance of its gains over twenty
    blocks, with the variance 6/5 of the slope of a walk of unit variance.
    """
    t = np.linspace(-0.5, 0.5, len(error))
    derivative = float(t @ error / (t @ t))
    gains = np.diff(error[np.linspace(0, len(error) - 1, BLOCKS + 1).astype(int)])
    return derivative, float(np.sqrt(1.2 * BLOCKS * np.var(gains, ddof=1)))


COMPARED = ("kepler:0.5", "henon-heiles", "outer-solar-system")
ERRORS = (1e-4, 1e-8, 1e-12)
METHODS = (SVI(4), SVI(8), StoermerVerlet(), Composition(8), Composition(10))
SHARE = 0.1
LONGEST, COARSEST = 0.5, 8.0
"""Seconds per trajectory beyond which no smaller step is tried; the first step, in units of the step of the case."""

FINER = math.sqrt(0.5)
MAX_REFINEMENTS = 60
RESOLVED = 1e-2
"""Largest error in the asymptotic regime of the order."""

REPEATS = 3


@without_accuracy_warnings()
def run_compositions(plan: Plan, report_activity: ReportActivity) -> ResultTable:
    """Measure milliseconds of a trajectory for each error, and the fastest method."""
    rows = []
    for name in COMPARED:
        plain = case(name)
        chosen = replace(plain, span=plain.span * SHARE * plan.share)
        curves = {}
        for method in METHODS:
            report_activity(f"compositions: {name}, {method.name}")
            curves[method.name] = _curve(chosen, method, LONGEST * plan.share)
        rows += [_row(chosen, error, curves) for error in ERRORS]
    return ResultTable(
        name="compositions",
        title="milliseconds of a trajectory at equal error",
        columns={"case": "", "span": "g", "error": ".0e"} | {method.name: "" for method in METHODS} | {"fastest": ""},
        rows=tuple(rows),
        remarks=(
            "~: not reached here (round-off, or more than half a second); extrapolated by the order of the method",
        ),
    )


def _row(chosen: Case, error: float, curves: dict[str, list[Point]]) -> dict[str, Any]:
    reached = {name: time_at(curve, error) for name, curve in curves.items()}
    orders = {method.name: method.order for method in METHODS}
    shown = {
        name: f"~{1e3 * _beyond(curves[name], error, orders[name]):.3g}" if seconds is None else f"{1e3 * seconds:.3g}"
        for name, seconds in reached.items()
    }
    fair = {name: seconds for name, seconds in reached.items() if seconds is not None}
    fastest = min(fair, key=lambda name: fair[name]) if fair else None
    return {"case": chosen.name, "span": chosen.span, "error": error, **shown, "fastest": fastest}


def _beyond(curve: list[Point], error: float, order: int | None) -> float:
    """Return the time for an error below all measured ones, extrapolated from the smallest by the order."""
    if not curve or not order:
        return math.nan
    best = min(curve, key=lambda point: point.error)
    return best.seconds * math.pow(best.error / error, 1.0 / order)


def _curve(chosen: Case, method: Method, longest: float) -> list[Point]:
    stepper = compile_stepper(chosen.system, method)
    momenta = momenta_of(stepper, chosen)
    exact = reference(chosen, momenta)
    points: list[Point] = []
    for refinement in range(MAX_REFINEMENTS):
        count = max(1, round(chosen.span / (COARSEST * chosen.step * FINER**refinement)))
        try:
            point = _point(stepper, chosen, momenta, count, exact)
        except StepFailedError:
            continue
        if point.error < RESOLVED:
            points.append(point)
        if point.error < 0.5 * min(ERRORS) or point.seconds > longest:
            break
    return points


def _point(stepper: Any, chosen: Case, momenta: Any, count: int, exact: Reference) -> Point:
    final, seconds = [], []
    for q, p in zip(chosen.q, momenta, strict=True):
        best = math.inf
        for _ in range(REPEATS):
            run = stepper.start(q, p, h=chosen.span / count)
            began = time.process_time()
            trajectory = run.record(count, save_every=count)
            best = min(best, time.process_time() - began)
            if best > 0.01:
                break
        final.append(trajectory.q[-1])
        seconds.append(best)
    return Point(seconds=float(np.mean(seconds)), error=rms_error(np.array(final), exact))


TOLERANCE = SolverOptions(tolerance=1e-14, max_iterations=1000, absolute=True)
SRK, SPECTRAL, COLLOCATION = "SRK", "SVI", "SC"

TABLES = (
    (6, "planar-pendulum", (0.5, 0.0), 0.5, {SRK: (Gauss(2), 13.73), SPECTRAL: (SVI(3), 4.94)}, 3, 1.85),
    (7, "duffing", (0.0, 1.0), 0.6, {SRK: (Gauss(3), 86.98), SPECTRAL: (SVI(5), 39.18)}, 5, 4.35),
)
"""Number, case, (q0, v0), h, methods with the printed seconds, degree of collocation and its seconds."""


@without_accuracy_warnings()
def run_paper_tables(plan: Plan, report_activity: ReportActivity) -> ResultTable:
    """Measure both tables."""
    rows: list[dict[str, Any]] = []
    for number, name, (q, v), h, methods, degree, seconds in TABLES:
        report_activity(f"tables: Table {number}, {name}")
        plain = case(name)
        chosen = replace(plain, q=np.array([[q]]), velocity=np.array([[v]]), span=plain.span * plan.share)
        named = methods | {COLLOCATION: (SpectralCollocation(degree), seconds)}
        rows += _table(number, chosen, h, named, 3 * plan.rounds)
    formats = {"table": "", "scheme": "", "method": "", "ms": ".3g", "ratio": ".2f", "in_the_paper": ".2f"}
    return ResultTable(
        name="tables",
        title="Tables 6 (pendulum, h = 0.5) and 7 (Duffing, h = 0.6) of the paper",
        columns=formats | {"energy_error": ".1e", "position_error": ".1e", "ms_a_digit": ".3g"},
        rows=tuple(rows),
        remarks=(
            "ratio: time over that of SRK, here and in the paper. energy error: largest along the run, relative.",
            "position error: at the end, relative. ms a digit: time over the correct digits of that position.",
            *(_verdict(number, [row for row in rows if row["table"] == number]) for number, *_ in TABLES),
        ),
    )


def _table(
    number: int, chosen: Case, h: float, methods: dict[str, tuple[Method, float]], repeats: int
) -> list[dict[str, Any]]:
    steppers = {scheme: compile_stepper(chosen.system, method) for scheme, (method, _) in methods.items()}
    exact, count = reference(chosen), round(chosen.span / h)
    seconds: dict[str, list[float]] = {scheme: [] for scheme in steppers}
    for _ in range(repeats):
        for scheme, stepper in steppers.items():
            seconds[scheme].append(_seconds(stepper, chosen, count))
    middle = {scheme: statistics.median(result) for scheme, result in seconds.items()}
    return [
        {
            "table": number,
            "scheme": scheme,
            "method": method.name,
            "ms": 1e3 * middle[scheme],
            "ratio": middle[scheme] / middle[SRK],
            "in_the_paper": printed / methods[SRK][1],
            **_errors(steppers[scheme], chosen, count, exact, 1e3 * middle[scheme]),
        }
        for scheme, (method, printed) in methods.items()
    ]


def _seconds(stepper: Stepper, chosen: Case, count: int) -> float:
    run = stepper.start(chosen.q[0], chosen.velocity[0], h=chosen.span / count, options=TOLERANCE)
    began = time.process_time()
    run.record(count, save_every=count)
    return time.process_time() - began


def _errors(stepper: Stepper, chosen: Case, count: int, exact: Reference, ms: float) -> dict[str, float]:
    """Return the errors of energy and position; both systems have p = v."""
    run = stepper.integrate(chosen.q[0], chosen.velocity[0], h=chosen.span / count, steps=count, options=TOLERANCE)
    energy = run.energy()
    position = rms_error(run.q[-1:], exact)
    digits = -math.log10(position)
    return {
        "energy_error": float(np.abs(energy / energy[0] - 1.0).max()),
        "position_error": position,
        "ms_a_digit": ms / digits if digits > 0.0 else math.nan,
    }


def _verdict(number: int, rows: Sequence[dict[str, Any]]) -> str:
    svi, srk = (next(row for row in rows if row["scheme"] == scheme) for scheme in (SPECTRAL, SRK))
    cheaper = "cheaper" if svi["ms"] < srk["ms"] else "dearer"
    better = "more" if svi["position_error"] < srk["position_error"] else "less"
    digits = abs(math.log10(srk["position_error"] / svi["position_error"]))
    share = svi["ms_a_digit"] / srk["ms_a_digit"]
    return (
        f"Table {number}: at the same step SVI is {cheaper} than SRK ({svi['ratio']:.2f} of its time), {better} "
        f"accurate by {digits:.1f} digits, and needs {share:.2f} of its time a correct digit."
    )
