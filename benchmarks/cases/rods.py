"""Chains of equal rods with a point mass at each end, released from an angle: with constraints, and in angles.

The package derives the angles from the constraints (:func:`scvi_codegen.eliminate_constraints`). Peers have the
accelerations by the tensions T_k of the rods, a tridiagonal system that is solved by elimination from the last rod.
"""

from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from benchmarks.cases.unforced import Array, Case, Vector, hand_solved, scaled
from benchmarks.contenders.ours import ADAPTIVE_TOLERANCES, compiled
from benchmarks.report import OURS, Contender
from scvi_codegen.methods.galerkin import SVI
from scvi_codegen.systems.elimination import eliminate_constraints
from scvi_codegen.systems.lagrangian import LagrangianSystem

RODS = (1, 2, 5)
SPANS = {1: 100.0, 2: 50.0, 5: 20.0}
ANGLE, GRAVITY = 0.3, 9.81


def points(n: int) -> LagrangianSystem:
    """Return n unit masses on rods of length 1 as points with constraints."""
    kinetic = " + ".join(f"(x{k}_dot**2 + y{k}_dot**2)/2 - g*y{k}" for k in range(1, n + 1))
    rods = [f"(x{k} - x{k - 1})**2 + (y{k} - y{k - 1})**2 = 1" for k in range(2, n + 1)]
    return LagrangianSystem.from_text(
        name=f"{n} rods",
        coordinates=[f"{axis}{k}" for k in range(1, n + 1) for axis in "xy"],
        lagrangian=kinetic,
        parameters={"g": GRAVITY},
        constraints=["x1**2 + y1**2 = 1", *rods],
    )


def rods(n: int) -> Case:
    """Return the case in angles."""
    q = scaled([ANGLE] * n, 0.05)
    return Case(
        name=f"rods:{n}",
        system=eliminate_constraints(points(n)),
        formulations=hand_solved(tensions),
        q=q,
        velocity=0.0 * q,
        span=SPANS[n],
        step=0.1,
    )


def tensions(q: Vector, v: Vector, of: Mapping[str, Any], functions: Any) -> list[Any]:
    """Return a_k'' = T_(k+1) sin(a_(k+1) - a_k) - T_(k-1) sin(a_k - a_(k-1)), with gravity in place of T_0."""
    n, g = len(q), of["g"]
    cosines = [functions.cos(q[k] - q[k + 1]) for k in range(n - 1)]
    sines = [functions.sin(q[k] - q[k + 1]) for k in range(n - 1)]
    right = [v[k] * v[k] for k in range(n)]
    right[0] = right[0] + g * functions.cos(q[0])
    diagonal: list[Any] = [1.0, *[2.0] * (n - 1)]
    for k in range(n - 2, -1, -1):
        factor = cosines[k] / diagonal[k + 1]
        diagonal[k] = diagonal[k] - factor * cosines[k]
        right[k] = right[k] + factor * right[k + 1]
    tension = [right[0] / diagonal[0]]
    for k in range(1, n):
        tension.append((right[k] + cosines[k - 1] * tension[k - 1]) / diagonal[k])
    result = [-g * functions.sin(q[0]), *(tension[k - 1] * sines[k - 1] for k in range(1, n))]
    return [result[k] - tension[k + 1] * sines[k] if k + 1 < n else result[k] for k in range(n)]


def with_constraints(case: Case, n: int, *, quick: bool) -> list[Contender]:
    """Return contenders with constraints and adaptive step size, by SVI(8); their angles are computed afterwards."""
    system = points(n)
    stepper, seconds = compiled(system, SVI(8, "gauss-lobatto:9"))
    maps = case.system.elimination  # type: ignore[attr-defined]

    def prepare(tolerance: float | None, index: int) -> Callable[[], Any]:
        q, p = maps.to_original(case.q[index], case.velocity[index])
        run = stepper.start(q, p, t_end=case.span, tolerance=tolerance)

        def integrate() -> Callable[[], Array]:
            run._run_to_target()
            ends = np.diff(np.array(run.q, dtype=float).reshape(-1, 2), axis=0, prepend=0.0)
            return lambda: np.arctan2(ends[:, 0], -ends[:, 1])

        return integrate

    made = Contender(f"{OURS} constraints", "", stepper.title, seconds, partial(prepare, None))
    tolerances = ADAPTIVE_TOLERANCES[: 2 if quick else None]
    return [replace(made, setting=f"tol={x or 0:.0e}", prepare=partial(prepare, x)) for x in tolerances]
