"""Pendulum of n links on a cart, from SymPy's description to a trajectory, by this package, by SymPy and by PyDy.

scvi-codegen   ``from_kanes_method`` of the bodies and loads, whose equations need not be formed; SVI(4).
lambdify       Kane's equations formed by SymPy, mass matrix and forcing by ``lambdify(..., cse=True)``, NumPy's solve,
               SciPy's DOP853.
PyDy           the same equations by its Cython generator, and DOP853.

Each is run in a process of its own: ``python -m scvi_codegen.benchmark.contenders.multibody NAME LINKS``.
"""

from __future__ import annotations

import json
import os
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from typing import Any

import numpy as np
import sympy
from sympy.physics.mechanics import KanesMethod, Particle, Point, ReferenceFrame, dynamicsymbols

from scvi_codegen.benchmark.cases.unforced import Array
from scvi_codegen.benchmark.report import OURS
from scvi_codegen.errors import StepFailedError

STEPS = (16, 32, 64, 128, 256, 512, 1024)
"""Numbers of steps of this package, in one second."""
TOLERANCES = (1e-5, 1e-7, 1e-9, 1e-11, 1e-13)
"""Tolerances of the others."""
ANGLE = 0.3
"""Initial angle of every link, at rest; no force acts on the cart."""
PATIENCE = 0.2
"""Processor seconds for which one setting is repeated."""

Solve = Callable[[float], Array]
"""Function that returns the coordinates after one second, for a number of steps or a tolerance."""


def pendulum(n: int) -> tuple[KanesMethod, dict[str, float]]:
    """Return the pendulum of ``sympy.physics.mechanics.models``, equations not formed, and its parameter values."""
    q, u = dynamicsymbols(f"q:{n + 1}"), dynamicsymbols(f"u:{n + 1}")
    masses, lengths, g = sympy.symbols(f"m:{n + 1}"), sympy.symbols(f"l:{n}"), sympy.Symbol("g")
    frame, origin = ReferenceFrame("I"), Point("O")
    origin.set_vel(frame, 0)
    at = origin.locatenew("P0", q[0] * frame.x)
    at.set_vel(frame, u[0] * frame.x)
    particles = [Particle("Pa0", at, masses[0])]
    for i in range(n):
        link = frame.orientnew(f"B{i}", "Axis", [q[i + 1], frame.z])
        link.set_ang_vel(frame, u[i + 1] * frame.z)
        end = at.locatenew(f"P{i + 1}", -lengths[i] * link.y)
        end.v2pt_theory(at, frame, link)
        particles.append(Particle(f"Pa{i + 1}", end, masses[i + 1]))
        at = end
    method = KanesMethod(
        frame,
        q_ind=q,
        u_ind=u,
        kd_eqs=[a.diff() - b for a, b in zip(q, u, strict=True)],
        bodies=particles,
        forcelist=[(particle.point, -particle.mass * g * frame.y) for particle in particles],
    )
    values = {f"m{i}": 1.0 / (n + 1) for i in range(n + 1)} | {f"l{i}": 1.0 / n for i in range(n)}
    return method, values | {"g": 9.81}


def start(n: int) -> Array:
    """Return (2 (n + 1),) coordinates and velocities."""
    return np.array([0.0, *[ANGLE] * n, *[0.0] * (n + 1)])


def ours(n: int) -> Solve:
    """Return a solver by a stepper, after its first step."""
    from scvi_codegen.compiler import compile_stepper
    from scvi_codegen.mechanics.lagrangian import LagrangianSystem
    from scvi_codegen.methods.galerkin import SVI

    method, values = pendulum(n)
    system = LagrangianSystem.from_kanes_method(method, name=f"{n} links", parameters=values)
    stepper = compile_stepper(system, SVI(4))
    q, v = np.split(start(n), 2)
    stepper.step(q, stepper.momentum(q, v), 1e-3)
    return lambda steps: stepper.integrate(q, velocity=v, h=1.0 / steps, steps=int(steps)).q[-1]


def by_lambdify(n: int) -> Solve:
    """Return a solver by SymPy's equations, after one call."""
    method, values = pendulum(n)
    method.kanes_equations()
    arguments = {symbol: values[symbol.name] for symbol in _constants(method, values)}
    state = {function: sympy.Dummy() for function in (*method.q, *method.u)}
    both = [part.xreplace(arguments).xreplace(state) for part in (method.mass_matrix, method.forcing)]
    equations = sympy.lambdify([list(state.values())], both, cse=True)

    def rates(t: float, x: Array) -> Array:
        mass, forcing = equations(x)
        return np.concatenate([x[n + 1 :], np.linalg.solve(mass, forcing[:, 0])])

    return _dop853(rates, n)


def by_pydy(n: int) -> Solve:
    """Return a solver by PyDy's Cython function, after one call."""
    from pydy.codegen.ode_function_generators import generate_ode_function

    method, values = pendulum(n)
    method.kanes_equations()
    constants = _constants(method, values)
    generated = generate_ode_function(
        method.forcing,
        list(method.q),
        list(method.u),
        constants,
        mass_matrix=method.mass_matrix,
        coordinate_derivatives=sympy.Matrix(list(method.u)),
        generator="cython",
    )
    numbers = np.array([values[symbol.name] for symbol in constants])
    return _dop853(lambda t, x: generated(x, t, numbers).copy(), n)  # the function reuses its array


def _constants(method: KanesMethod, values: Mapping[str, float]) -> list[sympy.Symbol]:
    free = method.mass_matrix.free_symbols | method.forcing.free_symbols
    return sorted((symbol for symbol in free if symbol.name in values), key=str)


def _dop853(rates: Callable[[float, Array], Array], n: int) -> Solve:
    from scipy.integrate import solve_ivp

    begin = start(n)
    rates(0.0, begin)

    def solve(tolerance: float) -> Array:
        result = solve_ivp(rates, (0.0, 1.0), begin, method="DOP853", rtol=tolerance, atol=tolerance)
        final: Array = result.y[: n + 1, -1]
        return final

    return solve


CONTENDERS: Mapping[str, Callable[[int], Solve]] = {OURS: ours, "lambdify": by_lambdify, "PyDy": by_pydy}
"""Functions from the number of links to a solver."""


def _processor_seconds() -> float:
    return sum(os.times()[:4])  # child processes (compilers) included


def _runs(solve: Solve, settings: Iterable[float]) -> Iterator[dict[str, Any]]:
    for setting in settings:
        try:
            final = solve(setting)
        except StepFailedError:  # too large a step
            continue
        seconds: list[float] = []
        while sum(seconds) < PATIENCE:
            began = time.process_time()
            solve(setting)
            seconds.append(time.process_time() - began)
        yield {"setting": setting, "seconds": float(np.median(seconds)), "q": final.tolist()}


if __name__ == "__main__":
    name, links = sys.argv[1:]
    began = _processor_seconds()
    solve = CONTENDERS[name](int(links))
    made = _processor_seconds() - began
    print(json.dumps({"first_step": made, "runs": list(_runs(solve, STEPS if name == OURS else TOLERANCES))}))
