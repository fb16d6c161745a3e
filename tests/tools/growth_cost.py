"""Print the cost of the check of error growth, as ``python tests/tools/growth_cost.py [run ...]``.

The cost is processor time with the check relative to ``check_growth=False``, minima of runs in alternation.
"""

import sys
import time
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from notation import lagrange

sys.path.insert(0, str(Path(__file__).parents[1] / "runs"))

from test_error_growth import CHAOTIC, REGULAR, TOLERANCES, reports, stepper_of

import scvi_codegen as sc
from scvi_codegen.interfaces.models.problems import problem

REPEATS, LEAST_SECONDS = 12, 0.3
ANISOTROPIC = ("x", "y"), "(x_dot**2/1.5 + y_dot**2*1.5)/2 + 1/sqrt(x**2 + y**2)"
DRIVEN = ("x",), "x_dot**2/2 + x**2/2 - x**4/4 + 0.3*x*cos(1.2*t)"
RUNS: dict[str, Callable[[], tuple[Any, Any, Any, float]]] = {
    **{
        f"{name} to t = {run[3]:g}": lambda run=run: (stepper_of(run[0]), *run[1:])
        for name, run in (REGULAR | CHAOTIC).items()
    },
    "anisotropic Kepler to t = 20": lambda: (stepper_of(ANISOTROPIC), [1.0, 0.2], [0.1, 0.9], 20.0),
    "driven Duffing oscillator to t = 300": lambda: (stepper_of(DRIVEN), [0.5], [0.1], 300.0),
    "rod in the plane, constraint, to t = 60": lambda: (_rod(), [0.6, -0.8], [0.8, 0.6], 60.0),
    "outer planets to t = 200,000 days": lambda: _problem("outer-solar-system", 2e5),
    "chain of 64 (FPUT) to t = 1000": lambda: _problem("fput-chain:64", 1000.0),
}


def _rod() -> sc.Stepper:
    system = lagrange("rod", "x y", "(x_dot**2 + y_dot**2)/2 - y", constraints=["x**2 + y**2 - 1"])
    return sc.compile_stepper(system, "svi:8")


def _problem(name: str, t_end: float) -> tuple[sc.Stepper, Any, Any, float]:
    case = problem(name)
    stepper = sc.compile_stepper(case.system, "svi:8")
    return stepper, case.q, stepper.momentum(case.q, case.velocity), t_end


def _processor_time(run: Callable[[], object]) -> float:
    start = time.process_time()
    run()
    return time.process_time() - start


def cost(stepper: sc.Stepper, q: Any, p: Any, t_end: float, tolerance: float | None) -> tuple[float, int]:
    """Return the relative cost of the check, and the number of steps."""
    arguments: dict[str, Any] = {"t_end": t_end, "tolerance": tolerance}
    steps = stepper.integrate(q, p, check_growth=False, **arguments).steps
    best, other = np.inf, np.inf
    end = time.process_time() + LEAST_SECONDS
    for k in range(10_000):
        if k >= REPEATS and time.process_time() > end:
            break
        best = min(best, _processor_time(lambda: stepper.integrate(q, p, check_growth=False, **arguments)))
        other = min(other, _processor_time(lambda: stepper.integrate(q, p, **arguments)))
    return other / best - 1.0, steps


def main(names: list[str]) -> None:
    warnings.simplefilter("ignore")
    print("| run | check | steps |", *(f"{each or 'round-off'} |" for each in TOLERANCES))
    print("| --- | --- | --- |", *("--- |" for _ in TOLERANCES))
    for name in names or RUNS:
        stepper, q, p, t_end = RUNS[name]()
        measured = [cost(stepper, q, p, t_end, tolerance) for tolerance in TOLERANCES]
        by = "tangent vector" if hasattr(stepper.start(q, p, t_end=t_end)._memory, "measures_growth") else "repetition"
        note = " (reported)" if reports(stepper, q, p, t_end) else ""
        print(f"| {name}{note} | {by} | {measured[0][1]:,} |", *(f"{100 * each:.0f} % |" for each, _ in measured))


if __name__ == "__main__":
    main(sys.argv[1:])
