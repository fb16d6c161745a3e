"""Benchmark of generated C and hand-written C (``hand_written.c``) of the Gauss method of eight stages."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from importlib.resources import files
from typing import Any

import numpy as np

from scvi_codegen.benchmark.cases import Array, Case, case
from scvi_codegen.benchmark.settings import Plan, ReportActivity
from scvi_codegen.benchmark.tables import ResultTable
from scvi_codegen.compiler import compile_stepper
from scvi_codegen.methods.galerkin import SVI
from scvi_codegen.native import building
from scvi_codegen.rendering.source import Source
from scvi_codegen.runtime.core.stepper import Stepper
from scvi_codegen.runtime.run.accuracy import without_accuracy_warnings
from scvi_codegen.tables.basis import continuation, extrapolation, matrix_product
from scvi_codegen.tables.precision import Matrix, mp
from scvi_codegen.tables.quadrature import gauss_legendre

__all__ = ["HAND_WRITTEN", "hand_written_source", "run_hand_written"]

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
    a, (b,) = (integrals(c, ends) for ends in (c, [mp.one]))
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


def integrals(points: Sequence[Any], ends: Sequence[Any]) -> Matrix:
    """Return row n: the integrals from 0 to ends[n] of the Lagrange cardinal polynomials of the points."""
    powers = range(len(points))
    cardinal = mp.matrix([[x**k for k in powers] for x in points]) ** -1
    table = mp.matrix([[x ** (k + 1) / (k + 1) for k in powers] for x in ends]) * cardinal
    return tuple(tuple(table[n, :]) for n in range(table.rows))


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
        iterations_counted = module.lib.hand_written(pointers[0], pointers[1], strength, h, count, every, pointers[2])
        return out, iterations_counted

    def generated(count: int, every: int) -> tuple[Array, int]:
        return _generated(stepper, chosen, h, count, every)

    seconds: dict[str, list[float]] = {"generated": [], "by_hand": []}
    iterations_counted = {}
    for _ in range(repeats):
        for name, function in (("generated", generated), ("by_hand", by_hand)):
            began = time.process_time()
            _, iterations_counted[name] = function(steps, steps)
            seconds[name].append(time.process_time() - began)
    one, other = generated(COMPARED, 1)[0], by_hand(COMPARED, 1)[0]
    middle = {name: float(np.median(result)) for name, result in seconds.items()}
    return {
        "case": chosen.name,
        "h": h,
        "generated_ns": 1e9 * middle["generated"] / steps,
        "by_hand_ns": 1e9 * middle["by_hand"] / steps,
        "ratio": middle["generated"] / middle["by_hand"],
        "apart": float(np.abs(one - other).max() / np.abs(other).max()),
        "generated_iterations": iterations_counted["generated"] / steps,
        "by_hand_iterations": iterations_counted["by_hand"] / steps,
    }


def _generated(stepper: Stepper, chosen: Case, h: float, count: int, every: int) -> tuple[Array, int]:
    run = stepper.integrate(
        chosen.q[0], stepper.momentum(chosen.q[0], chosen.velocity[0]), h=h, steps=count, save_every=every
    )
    return run.q[1:], int(run.iterations.sum())
