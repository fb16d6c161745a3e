"""Chains of equal rods with a point mass at each end, released from an angle: with constraints, and in angles.

In the angles a_k from the vertical, with n_jk = n + 1 - max(j, k) masses below the rods j and k, the Lagrangian is the
sum of n_jk cos(a_j - a_k) a_j' a_k' / 2 over all j and k, plus that of n_kk g cos(a_k). Peers have the accelerations by
the tensions T_k of the rods, a tridiagonal system that is solved by elimination from the last rod.
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


def in_angles(n: int) -> LagrangianSystem:
    """Return the same chain in the angles of its rods."""
    rods = range(1, n + 1)
    kinetic = [f"{n + 1 - k}*cos(a{j} - a{k})*a{j}_dot*a{k}_dot" for k in rods for j in range(1, k)]
    kinetic += [f"{n + 1 - k}*a{k}_dot**2/2" for k in rods]
    return LagrangianSystem.from_text(
        name=f"{n} rods in angles",
        coordinates=[f"a{k}" for k in rods],
        lagrangian=" + ".join([*kinetic, *(f"{n + 1 - k}*g*cos(a{k})" for k in rods)]),
        parameters={"g": GRAVITY},
    )


def rods(n: int) -> Case:
    """Return the case in angles."""
    q = scaled([ANGLE] * n, 0.05)
    return Case(
        name=f"rods:{n}",
        system=in_angles(n),
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

    def prepare(tolerance: float | None, index: int) -> Callable[[], Any]:
        angles = case.q[index]
        ends = np.cumsum(np.stack([np.sin(angles), -np.cos(angles)], axis=-1), axis=0)
        run = stepper.start(ends.ravel(), np.zeros(2 * n), t_end=case.span, tolerance=tolerance)  # at rest

        def integrate() -> Callable[[], Array]:
            run._run_to_target()
            ends = np.diff(np.array(run.q, dtype=float).reshape(-1, 2), axis=0, prepend=0.0)
            return lambda: np.arctan2(ends[:, 0], -ends[:, 1])

        return integrate

    made = Contender(f"{OURS} constraints", "", stepper.title, seconds, partial(prepare, None))
    tolerances = ADAPTIVE_TOLERANCES[: 2 if quick else None]
    return [replace(made, setting=f"tol={x or 0:.0e}", prepare=partial(prepare, x)) for x in tolerances]
