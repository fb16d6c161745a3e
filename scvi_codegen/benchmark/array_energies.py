"""Benchmark of the energy of array systems over a hundred thousand steps: growth by round-off."""

from __future__ import annotations

import time
from collections.abc import Iterator
from typing import Any

import numpy as np

from scvi_codegen.benchmark.contenders.contenders import OURS
from scvi_codegen.benchmark.drift import fitted_rate
from scvi_codegen.benchmark.large_cases import Lattice, atoms, bodies, breather, cloth, field, ring, waves
from scvi_codegen.benchmark.settings import Plan, ReportActivity
from scvi_codegen.benchmark.tables import ResultTable
from scvi_codegen.compiler import compile_stepper
from scvi_codegen.runtime.run.accuracy import without_accuracy_warnings

__all__ = ["run_energies"]

STEPS, QUICK_STEPS = 100_000, 2000
SAMPLES = 500
PARTS = 10
"""Number of parts of a run; the first is reported by itself."""


def problems(plan: Plan) -> Iterator[tuple[Lattice, float, float]]:
    """Yield each problem with a step size for SVI(8), with local error below round-off, and one for leapfrog."""
    if plan.quick:
        yield from ((ring(16, 1.0), 0.1, 0.02), (cloth(3, 1.0), 0.01, 0.002))
        return
    yield ring(1000, 1.0), 0.1, 0.02
    yield waves(1000, 1.0), 0.1, 0.02
    yield breather(1000, 1.0), 0.02, 0.004
    yield field(32, 1.0), 0.02, 0.004
    yield atoms(2, 1.0), 0.002, 0.0004
    yield cloth(20, 1.0), 0.01, 0.002
    yield bodies(32, 1.0), 0.01, 0.002


@without_accuracy_warnings()
def run_energies(plan: Plan, report_activity: ReportActivity) -> ResultTable:
    """Measure all problems with SVI(8) and with leapfrog."""
    steps = QUICK_STEPS if plan.quick else STEPS
    rows = []
    for each, h, short in problems(plan):
        for method, length in (("svi:8", h), ("stoermer-verlet", short)):
            report_activity(f"energies: {each.name} of {each.q.size} coordinates by {method}")
            rows.append(_row(each, method, length, steps))
    columns = {"problem": "", "coordinates": "d", "by": "", "h": "g", "seconds": ".1f"}
    errors = dict.fromkeys(("first_tenth", "largest", "at_the_end", "drift", "uncertainty"), ".1e")
    return ResultTable(
        name="energies",
        title=f"error of the energy over {steps} steps, relative to the largest kinetic energy",
        columns=columns | errors,
        rows=tuple(rows),
        remarks=(
            "first tenth, largest: largest error in the first tenth of the run, and in all of it; drift: slope of",
            "the fitted line times the length of the run, with its standard error. A random walk grows by a",
            "factor of about 3 from the first tenth to the end.",
        ),
    )


def _row(each: Lattice, method: str, h: float, steps: int) -> dict[str, Any]:
    stepper = compile_stepper(each.system, method)
    arguments: dict[str, Any] = {"parameters": each.parameters, "tables": each.tables}
    began = time.process_time()
    run = stepper.integrate(
        each.q,
        velocity=each.v,
        h=h,
        steps=steps,
        save_every=steps // SAMPLES or 1,
        observe=lambda run: run.t,
        **arguments,
    )
    seconds = time.process_time() - began
    error = (run.energy() - run.energy()[0]) / run.energies[:, 0].max()
    drift, uncertainty = fitted_rate(error)
    return {
        "problem": each.name,
        "coordinates": each.q.size,
        "by": f"{OURS} {method}",
        "h": h,
        "seconds": seconds,
        "first_tenth": float(np.abs(error[: len(error) // PARTS + 1]).max()),
        "largest": float(np.abs(error).max()),
        "at_the_end": float(error[-1]),
        "drift": drift,
        "uncertainty": uncertainty,
    }
