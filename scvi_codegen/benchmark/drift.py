"""Benchmark of energy drift over ten million steps of the Kepler problem; heyoka on the same spans."""

from __future__ import annotations

import importlib.util
import time
from typing import Any

import numpy as np

from scvi_codegen.benchmark.cases import Array, Case, case
from scvi_codegen.benchmark.contenders.taylor import heyoka_states
from scvi_codegen.benchmark.settings import Plan, ReportActivity
from scvi_codegen.benchmark.tables import ResultTable
from scvi_codegen.compiler import compile_stepper
from scvi_codegen.methods.galerkin import SVI
from scvi_codegen.runtime.core.stepper import Stepper
from scvi_codegen.runtime.run.accuracy import without_accuracy_warnings

__all__ = ["DRIFTS", "fitted_rate", "run_drift"]

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
