"""Benchmark of generated C and hand-written C (``hand_written.c``) of the Gauss method of eight stages.

Benchmark of a control step: set an input, step, read the state; compared with the bare C function and NumPy.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial
from importlib.resources import files
from typing import Any

import numpy as np

from scvi_codegen.benchmark.cases.unforced import Array, Case, case
from scvi_codegen.benchmark.report import ResultTable
from scvi_codegen.benchmark.settings import Plan, ReportActivity, seconds_in_turn
from scvi_codegen.compiler import compile_stepper
from scvi_codegen.mechanics.lagrangian import LagrangianSystem
from scvi_codegen.methods.galerkin import SVI
from scvi_codegen.native import building
from scvi_codegen.pipeline import generate_source
from scvi_codegen.rendering.source import Source
from scvi_codegen.runtime.core.stepper import Stepper
from scvi_codegen.runtime.run.accuracy import without_accuracy_warnings
from scvi_codegen.tables.basis import cardinal_integrals, continuation, extrapolation, matrix_product
from scvi_codegen.tables.precision import mp
from scvi_codegen.tables.quadrature import gauss_legendre

HAND_WRITTEN = {"planar-pendulum": 0.8, "kepler:0.2": 0.5, "kepler:0.5": 0.2}
"""Cases with a step size."""

STAGES = 8
STEPS = 20_000
COMPARED = 100
"""Number of steps over which positions are compared; later, round-off has grown."""

DECLARATIONS = (
    "long hand_written(double *q, double *v, double strength, double h, long steps, long every, double *out);"
)


@without_accuracy_warnings()
def run_hand_written(plan: Plan, report_activity: ReportActivity) -> ResultTable:
    """Measure nanoseconds per step of both in turn, and the difference of their final states."""
    rows = []
    for name, h in HAND_WRITTEN.items():
        report_activity(f"hand-written: {name}")
        rows.append(_compare(case(name), h, repeats=3 * plan.repeats, steps=STEPS // 20 if plan.quick else STEPS))
    return ResultTable(
        name="hand-written",
        title="generated C and hand-written C of the same method",
        columns={"case": "", "h": "g", "generated_ns": ".0f", "by_hand_ns": ".0f", "ratio": ".2f", "apart": ".1e"}
        | {"generated_iterations": ".2f", "by_hand_iterations": ".2f"},
        rows=tuple(rows),
        remarks=(
            "ratio: time of the generated over that of the hand-written code, medians; above 1 the latter is faster;",
            f"apart: largest difference of positions over {COMPARED} steps, relative.",
        ),
    )


def hand_written_source(pendulum: bool) -> Source:
    """Return the C source with its constants."""
    header = "\n".join(["#define PENDULUM" if pendulum else "", *_constants(), DECLARATIONS, ""])
    code = files("scvi_codegen.benchmark").joinpath("hand_written.c").read_text(encoding="utf-8")
    return Source(prefix="hand_written", header=header, code=code, declarations=DECLARATIONS)


def _constants() -> Iterator[str]:
    """Yield definitions of the type ``lanes``, of vectors (one row) and of tables, column by column."""
    c = gauss_legendre(STAGES).abscissae
    table = cardinal_integrals(c, (*c, mp.one), 0)
    a, b = table[:-1], table[-1]
    product = matrix_product(a, a)
    yield "typedef double lanes __attribute__((vector_size(64)));"
    for name, table in (("C", (tuple(c),)), ("B", (b,)), ("BB", matrix_product((b,), a)), ("AA", product)):
        high = [[float(x) for x in row] for row in table]
        yield _definition(name, high)
        yield _definition(
            f"{name}_LOW",
            [[float(x - y) for x, y in zip(*rows, strict=True)] for rows in zip(table, high, strict=True)],
        )
    for name, guess in zip(("ALONE", "LAST", "BEFORE"), (extrapolation(c, 1, 7), *continuation(c, 12)), strict=True):
        yield _definition(name, [[float(x) for x in row] for row in matrix_product(product, guess)])


def _definition(name: str, rows: list[list[float]]) -> str:
    columns = ["{" + ", ".join(map(repr, column)) + "}" for column in zip(*rows, strict=True)]
    if len(rows) == 1:
        return f"static const lanes {name} = {{{', '.join(repr(x) for x in rows[0])}}};"
    return f"static const lanes {name}[{len(columns)}] = {{{', '.join(columns)}}};"


def _compare(chosen: Case, h: float, *, repeats: int, steps: int) -> dict[str, Any]:
    stepper = compile_stepper(chosen.system, SVI(STAGES))
    module = building.load(hand_written_source(pendulum=chosen.dimension == 1))
    strength = chosen.parameters.get("mu", 1.0)

    def by_hand(count: int, every: int) -> tuple[Array, int]:
        q, v = chosen.q[0].copy(), chosen.velocity[0].copy()
        out = np.empty((count // every, chosen.dimension))
        pointers = [module.ffi.from_buffer("double[]", array) for array in (q, v, out)]
        return out, module.lib.hand_written(pointers[0], pointers[1], strength, h, count, every, pointers[2])

    generated = partial(_generated, stepper, chosen, h)
    works = {"generated": partial(generated, steps, steps), "by_hand": partial(by_hand, steps, steps)}
    middle = {name: float(np.median(seconds)) for name, seconds in seconds_in_turn(works, repeats).items()}
    iterations = {name: work()[1] / steps for name, work in works.items()}
    one, other = generated(COMPARED, 1)[0], by_hand(COMPARED, 1)[0]
    return {
        "case": chosen.name,
        "h": h,
        "generated_ns": 1e9 * middle["generated"] / steps,
        "by_hand_ns": 1e9 * middle["by_hand"] / steps,
        "ratio": middle["generated"] / middle["by_hand"],
        "apart": float(np.abs(one - other).max() / np.abs(other).max()),
        "generated_iterations": iterations["generated"],
        "by_hand_iterations": iterations["by_hand"],
    }


def _generated(stepper: Stepper, chosen: Case, h: float, count: int, every: int) -> tuple[Array, int]:
    run = stepper.integrate(
        chosen.q[0], stepper.momentum(chosen.q[0], chosen.velocity[0]), h=h, steps=count, save_every=every
    )
    return run.q[1:], int(run.iterations.sum())


CALLS = 20_000
"""Number of calls of each kind in a round."""
STEP = 0.01
METHODS = ("svi:2", "svi:4")
PUSH = 0.1
SYSTEMS = {
    "pendulum": LagrangianSystem.from_text(
        name="pushed pendulum",
        coordinates=["q"],
        lagrangian="q_dot**2/2 + cos(q)",
        forces={"q": "u"},
        inputs=["u"],
    ),
    "cart-pole": LagrangianSystem.from_text(
        name="cart and pole",
        coordinates=["x", "a"],
        lagrangian="(M + m)*x_dot**2/2 + m*l*x_dot*a_dot*cos(a) + m*l**2*a_dot**2/2 - m*g*l*cos(a)",
        parameters={"M": 1.0, "m": 0.2, "l": 0.5, "g": 9.81},
        forces={"x": "u"},
        inputs=["u"],
    ),
}


class Sampling:
    """Steps from one state, by each way of performing them.

    Attributes:
        held, advanced: runs whose input is set before every step, and once.
        calls: a function without arguments for each column.
    """

    def __init__(self, system: LagrangianSystem, method: str) -> None:
        stepper, alone = compile_stepper(system, method), Stepper(*generate_source(system, method))
        at = np.full(stepper.dimension, 0.3)
        self.advanced, self.held, bare = (each.start(at, 0.0 * at, h=STEP) for each in (stepper, stepper, alone))
        for run in (self.advanced, bare):
            run.set_inputs(u=PUSH)
        binding, self._values = alone.binding, bare.parameters
        self._memory, report, room = binding.new("run *"), binding.new("report *"), binding.workspace()
        binding.buffer(self._memory)[:] = bare.checkpoint()
        step, values, null = binding.function("advance", self._memory), binding.pointer(self._values), binding.null
        self.calls: dict[str, Callable[[], object]] = {
            "bare": lambda: step(1, 2**53, values, null, null, null, null, null, report, room),
            "assign": self._assign,
            "hold": lambda: self.advanced.set_inputs(u=PUSH),
            "advance": lambda: self.advanced.advance(1),
            "sample": self._sample,
            "look": lambda: (self.advanced.q, self.advanced.p),
        }

    def _assign(self) -> None:
        self._values[-5:] = PUSH, 0.0, 0.0, 0.0, 0.0

    def _sample(self) -> None:
        self.held.set_inputs(u=PUSH)
        self.held.advance(1)

    def states(self) -> list[list[float]]:
        """Return the positions of each run."""
        return [self.advanced.q.tolist(), self.held.q.tolist(), list(self._memory.q)]


def run_control_loop(plan: Plan, report_activity: ReportActivity) -> ResultTable:
    """Measure microseconds per call: minima of processor time, all in turn, round after round."""
    rows = []
    for name, system in SYSTEMS.items():
        for method in METHODS:
            report_activity(f"samples: {name} by {method}")
            times = _fastest(Sampling(system, method).calls, plan)
            over = {"hold_over": times["hold"] - times["assign"], "advance_over": times["advance"] - times["bare"]}
            rows.append({"system": name, "by": method} | times | over)
    return ResultTable(
        name="control-loop",
        title="microseconds per control step",
        columns={"system": "", "by": ""}
        | dict.fromkeys([key for key in rows[0] if key not in ("system", "by")], ".2f"),
        rows=tuple(rows),
        remarks=(
            "bare: C's function, called with pointers at hand, a step; assign: NumPy's, of the five numbers of an",
            "input; hold: run.set_inputs(u=...); advance: run.advance(1); sample: both; look: run.q and run.p; over:",
            "what a call costs beyond NumPy's, and C's. Minima of processor time; a call from a Python function is in",
            "each.",
        ),
    )


def _fastest(calls: dict[str, Callable[[], object]], plan: Plan) -> dict[str, Any]:
    """Return the microseconds of each."""
    count = max(1, int(CALLS * plan.share))

    def repeated(call: Callable[[], object]) -> None:
        for _ in range(count):
            call()

    works = {name: partial(repeated, call) for name, call in calls.items()}
    return {name: 1e6 * min(seconds) / count for name, seconds in seconds_in_turn(works, plan.rounds).items()}
