"""Ten million steps of Kepler's problem: does the energy drift?"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from scvi_codegen.benchmark.cases import Array, case
from scvi_codegen.compiler import compile_stepper
from scvi_codegen.methods.galerkin import SVI
from scvi_codegen.methods.method import Method

__all__ = ["CASES_OF_DRIFT", "DriftRow", "drift_of", "drift_table", "fitted_slope", "measure_drift"]

CASES_OF_DRIFT = {"kepler:0.2": (0.5, 0.35, 0.2), "kepler:0.5": (0.2, 0.15, 0.1)}
"""Three step sizes each, from the largest without a visible truncation error down."""

SAMPLES = 2000
BLOCKS = 20


@dataclass(frozen=True, slots=True, kw_only=True)
class DriftRow:
    """One long run; energies are relative to the first.

    Attributes:
        case, h, steps, seconds: what was run.
        final: error at the end.
        largest: largest error on the way.
        slope: of the line fitted to the error over the whole run, times its length: the drift.
        slope_error: its standard error.
    """

    case: str
    h: float
    steps: int
    seconds: float
    final: float
    largest: float
    slope: float
    slope_error: float


def fitted_slope(error: Array) -> tuple[float, float]:
    """Slope of a line fitted to equidistant samples, times their length, and its standard error.

    Round-off makes the energy walk at random, so the residuals of the fit are far from independent and the usual error
    is too small. The walk's increments are independent: the error comes from the scatter of its gains over twenty
    blocks, by the variance 6/5 of the slope of a walk of unit variance.
    """
    t = np.linspace(-0.5, 0.5, len(error))
    slope = float(t @ error / (t @ t))
    gains = np.diff(error[np.linspace(0, len(error) - 1, BLOCKS + 1).astype(int)])
    return slope, float(np.sqrt(1.2 * BLOCKS * np.var(gains, ddof=1)))


def drift_of(name: str, h: float, steps: int, method: Method | None = None) -> DriftRow:
    """Run one case for many steps and fit its energy."""
    chosen = case(name)
    stepper = compile_stepper(chosen.system, method or SVI(8))
    q, p = chosen.q[0], stepper.momentum(chosen.q[0], chosen.velocity[0])
    began = time.perf_counter()
    run = stepper.integrate(q, p, h=h, steps=steps, every=max(1, steps // SAMPLES))
    seconds = time.perf_counter() - began
    energy = run.energy()
    error = (energy - energy[0]) / abs(energy[0])
    slope, slope_error = fitted_slope(error)
    return DriftRow(
        case=name,
        h=h,
        steps=steps,
        seconds=seconds,
        final=float(error[-1]),
        largest=float(np.abs(error).max()),
        slope=slope,
        slope_error=slope_error,
    )


def measure_drift(steps: int, progress: Callable[[str], None] = lambda text: None) -> list[DriftRow]:
    """All cases at all step sizes."""
    result = []
    for name, sizes in CASES_OF_DRIFT.items():
        for h in sizes:
            progress(f"{name}, h = {h:g}, {steps} steps")
            result.append(drift_of(name, h, steps))
    return result


def drift_table(found: Sequence[DriftRow]) -> str:
    """The rows as text."""
    names = f"{'at the end':>12}{'largest':>10}{'drift':>11}{'+-':>10}{'ns/step':>9}"
    header = f"{'relative energy error':24}{'steps':>10}{names}"
    lines = [
        f"{row.case:14}h={row.h:<8g}{row.steps:>10}{row.final:>12.1e}{row.largest:>10.1e}"
        f"{row.slope:>11.1e}{row.slope_error:>10.1e}{1e9 * row.seconds / row.steps:>9.0f}"
        for row in found
    ]
    return "\n".join([header, *lines, "drift: slope of the fitted line times the length of the run"])
