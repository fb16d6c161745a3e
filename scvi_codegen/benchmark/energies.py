"""Benchmark of energy drift: Kepler's problem over ten million steps, heyoka on the same spans, and array systems."""

from __future__ import annotations

import importlib.util
from collections.abc import Iterator
from typing import Any

import numpy as np

from scvi_codegen.benchmark.cases.large import Lattice, atoms, bodies, breather, cloth, field, ring, waves
from scvi_codegen.benchmark.cases.unforced import Array, Case, case
from scvi_codegen.benchmark.contenders.taylor import heyoka_states
from scvi_codegen.benchmark.report import OURS, ResultTable
from scvi_codegen.benchmark.settings import Plan, ReportActivity, timed
from scvi_codegen.compiler import compile_stepper
from scvi_codegen.methods.galerkin import SVI
from scvi_codegen.runtime.run.accuracy import without_accuracy_warnings

DRIFTS = {"kepler:0.2": (0.5, 0.35, 0.2), "kepler:0.5": (0.2, 0.15, 0.1)}
"""Three step sizes for each case, from the largest without a visible truncation error down."""

STEPS, QUICK_STEPS = 10_000_000, 20_000
"""Numbers of steps of a case."""
ARRAY_STEPS, QUICK_ARRAY_STEPS = 100_000, 2000
"""Numbers of steps of an array system."""
SAMPLES, ARRAY_SAMPLES = 2000, 500
BLOCKS = 20
PARTS = 10
"""Number of parts of a run; the first is reported by itself."""


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
    return _table("drift", f"energy error over {steps} steps, relative to the energy", rows)


@without_accuracy_warnings()
def run_energies(plan: Plan, report_activity: ReportActivity) -> ResultTable:
    """Measure array systems with SVI(8) and with leapfrog."""
    steps = QUICK_ARRAY_STEPS if plan.quick else ARRAY_STEPS
    rows = []
    for each, h, short in problems(plan):
        for method, length in (("svi:8", h), ("stoermer-verlet", short)):
            report_activity(f"energies: {each.name} of {each.q.size} coordinates by {method}")
            rows.append(_array_row(each, method, length, steps))
    return _table("energies", f"energy error over {steps} steps, relative to the largest kinetic energy", rows)


def _table(name: str, title: str, rows: list[dict[str, Any]]) -> ResultTable:
    columns = {"problem": "", "coordinates": "d", "by": "", "h": "g", "span": ".0f", "seconds": ".2f"}
    errors = dict.fromkeys(("first_tenth", "largest", "at_the_end", "drift", "uncertainty"), ".1e")
    return ResultTable(
        name=name,
        title=title,
        columns=columns | errors,
        rows=tuple(rows),
        remarks=(
            "first tenth, largest: largest error in the first tenth of the run, and in all of it; a random walk grows",
            "by a factor of about 3. drift: slope of the fitted line times the length of the run. uncertainty: its",
            f"standard error, from the variance of the gains over {BLOCKS} blocks.",
        ),
    )


def drift_rows(chosen: Case, h: float, steps: int, *, with_heyoka: bool) -> list[dict[str, Any]]:
    """Return one row per method, from the first state of a case."""
    stepper = compile_stepper(chosen.system, SVI(8))
    q, p = chosen.q[0], stepper.momentum(chosen.q[0], chosen.velocity[0])
    save_every, half = max(1, steps // SAMPLES), chosen.dimension
    seconds, run = timed(lambda: stepper.integrate(q, p, h=h, steps=steps, save_every=save_every))
    result = [(f"{OURS} svi:8", h, seconds, run.energy())]
    if with_heyoka:
        times = np.linspace(0.0, h * steps, steps // save_every + 1)
        seconds, states = timed(lambda: heyoka_states(chosen, times))
        result.append(("heyoka", float("nan"), seconds, stepper.energy(states[:, :half], states[:, half:])))
    given = {"problem": chosen.name, "coordinates": half, "span": h * steps}
    return [
        {**given, "by": by, "h": size, "seconds": seconds} | _entries(energy, abs(energy[0]))
        for by, size, seconds, energy in result
    ]


def _array_row(each: Lattice, method: str, h: float, steps: int) -> dict[str, Any]:
    stepper = compile_stepper(each.system, method)
    how: dict[str, Any] = {"h": h, "steps": steps, "parameters": each.parameters, "tables": each.tables}
    how |= {"save_every": steps // ARRAY_SAMPLES or 1, "observe": lambda run: run.t}
    seconds, run = timed(lambda: stepper.integrate(each.q, velocity=each.v, **how))
    row = {"problem": each.name, "coordinates": each.q.size, "by": f"{OURS} {method}", "h": h, "span": h * steps}
    return row | {"seconds": seconds} | _entries(run.energy(), run.energies[:, 0].max())


def _entries(energy: Array, unit: float) -> dict[str, float]:
    error = (energy - energy[0]) / unit
    drift, uncertainty = fitted_rate(error)
    return {
        "first_tenth": float(np.abs(error[: len(error) // PARTS + 1]).max()),
        "largest": float(np.abs(error).max()),
        "at_the_end": float(error[-1]),
        "drift": drift,
        "uncertainty": uncertainty,
    }


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
