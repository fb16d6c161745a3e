"""Section of 31 digits: double-double steps of this package, and heyoka in long double and quadruple precision."""

import importlib.util
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from functools import partial
from typing import Any

import numpy as np
from mpmath import mp

from benchmarks.cases.unforced import Case, Vector, case
from benchmarks.comparison import measure
from benchmarks.report import LEAST, Contender, Measurement, ResultTable, common_error, time_at
from benchmarks.settings import Plan, ReportActivity
from scvi_codegen.runs.accuracy.warning_switch import without_accuracy_warnings
from scvi_codegen.runs.compiler import compile_stepper
from scvi_codegen.runs.states.words import as_mpmath

SPANS = {
    "planar-pendulum": (1536.0, 384),
    "duffing": (1536.0, 768),
    "kepler:0.5": (1536.0, 768),
    "henon-heiles": (1536.0, 384),
    "fput-chain:8": (384.0, 96),
    "outer-solar-system": (196608.0, 192),
}
"""Spans and smallest numbers of steps; both are three times powers of two, so that all step sizes are exact."""
METHODS = ("svi:12", "svi:16", "svi:24")
STEPS = {True: (2, 4), False: (1, 4 / 3, 2, 8 / 3, 4, 16 / 3, 8, 16)}
"""Multiples of the numbers of steps, for quick and whole comparisons."""
KINDS: Mapping[str, tuple[str, tuple[float, ...], tuple[float, ...]]] = {
    "heyoka long double": ("longdouble", (1e-15, 1e-17, 0.0), ()),
    "heyoka real128": ("real128", (1e-22, 1e-26, 1e-30, 0.0), (1e-20, 1e-24, 1e-28)),
}
"""Types of numbers, tolerances (0: heyoka's default, the machine epsilon), and errors at which times are compared."""
UNROLLED, REFERENCE_BITS = 4, 200
"""Most coordinates of unrolled code, which takes minutes to compile in quadruple precision; bits of the reference."""


@without_accuracy_warnings()
def run_digits(plan: Plan, report_activity: ReportActivity) -> ResultTable:
    """Compare the times at equal error of six problems from one initial state each, below the errors of doubles."""
    rows = [row for name in list(SPANS)[: 2 if plan.quick else None] for row in _rows(name, plan, report_activity)]
    formats = {"problem": "", "peer": "", "at_error": ".0e", "peer_ms": ".3g", "our_ms": ".3g", "ratio": ".3g"}
    return ResultTable(
        name="digits",
        title=f"precision='double-double', fastest of {', '.join(METHODS)} at fixed step size, at equal error",
        columns=formats | {"smallest": ".0e", "our_smallest": ".0e", "reference": ".0e"},
        rows=tuple(rows),
        remarks=(
            "last error: twice the larger of the smallest errors of both; reference: its accuracy, difference of two",
            f"tolerances of heyoka with {REFERENCE_BITS} bits. Processor times, medians. ratio: peer / ours.",
        ),
    )


def _rows(name: str, plan: Plan, report_activity: ReportActivity) -> Iterator[dict[str, Any]]:
    if "heyoka" not in plan.peers or importlib.util.find_spec("heyoka") is None:
        yield {"problem": name, "peer": "heyoka is not installed or not among the peers"}
        return
    part = 1 / 16 if plan.quick else 1
    span, fewest = SPANS[name][0] * part, round(SPANS[name][1] * part)
    chosen = case(name)
    q, velocity = chosen.q[0], chosen.velocity[0]
    if chosen.bodies is not None and not chosen.bodies.fixed_centre:
        q, velocity = (barycentric(each, chosen.bodies.masses) for each in (q, velocity))
    start = np.concatenate([q, velocity])
    report_activity(f"digits: {name}, reference")
    reference, other = (_Taylor(chosen, "real", tolerance).run(start, span) for tolerance in (0.0, 1e-45))

    def error(final: Any) -> float:
        with mp.workprec(REFERENCE_BITS):
            difference = mp.norm([x - y for x, y in zip(final, reference, strict=True)])
            return float(difference / mp.norm(reference))

    report_activity(f"digits: {name}, compiling")
    contenders = [
        _ours(chosen, method, start, span, round(fewest * k), error) for method in METHODS for k in STEPS[plan.quick]
    ]
    for curve, (kind, tolerances, _) in KINDS.items():
        contenders += [_Taylor(chosen, kind, x).contender(curve, start, span, error) for x in tolerances]
    report_activity(f"digits: {name}, {len(contenders)} settings")
    measured = measure(contenders, lambda _: None, repeats=plan.rounds)  # type: ignore[arg-type, return-value]
    ours = [each for each in measured if each.method in METHODS and not each.failure]
    for curve, (*_, errors) in KINDS.items():
        peer = [each for each in measured if each.method == curve and not each.failure]
        for entries in compared(ours, peer, errors):
            yield {"problem": name, "peer": curve, "reference": error(other), **entries}


def compared(ours: list[Measurement], peer: list[Measurement], errors: Iterable[float]) -> Iterator[dict[str, Any]]:
    """Yield the smallest errors, and times at equal error in milliseconds with their ratio, where both have it."""
    smallest = [min((each.error for each in points), default=None) for points in (ours, peer)]
    entries = {"our_smallest": smallest[0], "smallest": smallest[1]}
    least = common_error(ours, peer, floor=LEAST)
    if least is None:
        yield entries
        return
    largest = min(max(each.error for each in points) for points in (ours, peer))
    for at_error in (*(each for each in errors if least < each <= largest), least):
        mine, theirs = (time_at(points, at_error, floor=LEAST) for points in (ours, peer))
        assert mine is not None
        assert theirs is not None
        times = {"at_error": at_error, "our_ms": 1e3 * mine, "peer_ms": 1e3 * theirs, "ratio": theirs / mine}
        yield entries | times


def barycentric(vectors: Any, masses: tuple[float, ...]) -> Any:
    """Return positions or velocities of bodies in space relative to those of the centre of mass."""
    bodies = np.reshape(vectors, (len(masses), 3))
    return (bodies - np.average(bodies, axis=0, weights=masses)).ravel()


def _ours(chosen: Case, method: str, start: Any, span: float, steps: int, error: Callable[[Any], float]) -> Contender:
    began = time.perf_counter()
    stepper = compile_stepper(chosen.system, method, precision="double-double")
    seconds, m = time.perf_counter() - began, chosen.dimension
    p = stepper.momentum(start[:m], start[m:])

    def integrate() -> Callable[[], Vector]:
        run = stepper.integrate(start[:m], p, h=span / steps, steps=steps, save_every=steps)
        return partial(as_mpmath, run.q[-1])

    options = "double-double, fixed step size"
    return Contender(method, f"{steps} steps", options, seconds, lambda _: integrate, starts=1, error=error)


class _Taylor:
    """heyoka's integrator in numbers of a kind, with the hand-derived accelerations of a case."""

    def __init__(self, chosen: Case, kind: str, tolerance: float) -> None:
        import heyoka

        self.tolerance, self.m, self.kind = tolerance, chosen.dimension, kind
        self.number: Callable[[float], Any] = np.longdouble if kind == "longdouble" else getattr(heyoka, kind)
        bits = {"prec": REFERENCE_BITS} if kind == "real" else {}
        if kind == "real":
            self.number = lambda x: heyoka.real(float(x), REFERENCE_BITS)
        x = heyoka.make_vars(*[f"{part}{n}" for part in "qv" for n in range(self.m)])
        rates = chosen.formulations[0].rates(x, chosen.parameters, heyoka)
        began = time.perf_counter()
        self.integrator = heyoka.taylor_adaptive(
            list(zip(x, rates, strict=True)),
            self.numbers(np.arange(1.0, 2.0 * self.m + 1.0)),
            fp_type=np.longdouble if kind == "longdouble" else getattr(heyoka, kind),
            tol=self.number(tolerance),
            compact_mode=self.m > UNROLLED or kind == "real",
            **bits,
        )
        self.seconds = time.perf_counter() - began

    def numbers(self, values: Any) -> Any:
        """Return an array of numbers of the kind."""
        return np.array([self.number(float(x)) for x in values])

    def run(self, start: Any, span: float) -> Vector:
        """Return the final positions as mpmath numbers."""
        self.prepared(start)
        return self.integrate(span)()

    def prepared(self, start: Any) -> None:
        """Return to the initial state."""
        self.integrator.time = self.number(0.0)
        self.integrator.state[:] = self.numbers(start)

    def integrate(self, span: float) -> Callable[[], Vector]:
        """Integrate, and return a function that converts the final positions."""
        outcome = self.integrator.propagate_until(self.number(span))
        if "time_limit" not in str(outcome[0]):
            raise ArithmeticError(f"heyoka stopped with {outcome[0]}")
        final = self.integrator.state[: self.m].copy()

        def converted() -> Vector:
            with mp.workprec(REFERENCE_BITS):
                return [mp.mpf(str(x)) for x in final]

        return converted

    def contender(self, curve: str, start: Any, span: float, error: Callable[[Any], float]) -> Contender:
        """Return a contender from one state."""
        setting = f"tol={self.tolerance:.0e}" if self.tolerance else "tol=default"
        code = "compact" if self.m > UNROLLED else "unrolled"

        def prepare(_: int) -> Callable[[], Any]:
            self.prepared(start)
            return partial(self.integrate, span)

        options = f"hand-solved accelerations, {code}, order {self.integrator.order}"
        return Contender(curve, setting, options, self.seconds, prepare, starts=1, error=error)
