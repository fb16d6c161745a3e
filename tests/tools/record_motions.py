"""Record the motions of ``oracles/motions.py`` by heyoka's Taylor method in quadruple precision: ``motions.npz``.

The equations of motion are derived here by SymPy. Times are those of steps, frequent where a motion is fast, and evenly
spaced ones. Usage: ``python tests/tools/record_motions.py``.
"""

import sys
from pathlib import Path
from typing import Any

import heyoka as hy
import mpmath
import numpy as np
import sympy as sp
from notation import lagrange

sys.path.insert(0, str(Path(__file__).parents[1] / "oracles"))
from motions import MOTIONS, RECORDS, Motion

import scvi_codegen as sc

Real = hy.real128
FUNCTIONS = {sp.cos: hy.cos, sp.sin: hy.sin, sp.exp: hy.exp, sp.cosh: hy.cosh, sp.sinh: hy.sinh}
STEPS, EVEN = 18, 12


def quadruple(x: Any) -> Any:
    return Real(mpmath.nstr(mpmath.mpf(x), 40))


def translated(e: Any, known: dict[Any, Any]) -> Any:
    """Return a SymPy expression as heyoka's, with rational numbers in quadruple precision."""
    if e in known:
        return known[e]
    if e.is_Rational:
        return hy.expression(Real(str(e.p))) / hy.expression(Real(str(e.q)))
    parts = [translated(each, known) for each in e.args]
    if e.is_Add:
        return hy.sum(parts)
    if e.is_Mul or (e.is_Pow and e.exp.is_Integer and e.exp > 0):
        parts = parts if e.is_Mul else parts[:1] * int(e.exp)
        return parts[0] * translated(sp.Mul(*e.args[1:]), known) if e.is_Mul else product(parts)
    if e.is_Pow:
        root = hy.sqrt(parts[0]) if e.exp.q == 2 else parts[0]
        power = product([root] * abs(e.exp.p))
        return power if e.exp > 0 else hy.expression(Real("1")) / power
    return FUNCTIONS[e.func](*parts)


def product(factors: list[Any]) -> Any:
    result = factors[0]
    for each in factors[1:]:
        result = result * each
    return result


def states(motion: Motion, times: np.ndarray, velocity: np.ndarray) -> list[list[mpmath.mpf]]:
    """Return the positions and momenta at times, the first of them that of the initial state and this velocity."""
    t, names = sp.Symbol("t"), motion.coordinates.split()
    q, v = ([sp.Symbol(name + end) for name in names] for end in ("", "_dot"))
    symbols = {symbol.name: symbol for symbol in (*q, *v, t)}
    lagrangian, *forces = (
        sp.nsimplify(sp.sympify(text, locals=symbols), rational=True)
        for text in (motion.lagrangian, *(motion.forces.get(name, "0") for name in names))
    )
    p = sp.Matrix([lagrangian]).jacobian(v).T
    mass = p.jacobian(v)
    rest = sp.Matrix([lagrangian]).jacobian(q).T + sp.Matrix(forces) - p.diff(t) - p.jacobian(q) * sp.Matrix(v)
    accelerations = [each / mass[i, i] for i, each in enumerate(rest)] if mass.is_diagonal() else mass.LUsolve(rest)
    arguments = (t, *q, *v)
    momenta, matrix = (sp.lambdify(arguments, each, modules="mpmath") for each in (p, mass))
    start, velocity = [mpmath.mpf(x) for x in motion.q], mpmath.matrix(velocity)
    for _ in range(5):  # Newton's iteration for the last digits of the initial velocity
        now = (mpmath.mpf(times[0]), *start, *velocity)
        velocity -= mpmath.lu_solve(matrix(*now), momenta(*now) - mpmath.matrix(motion.p))
    known = {symbol: hy.make_vars(symbol.name) for symbol in (*q, *v)} | {t: hy.time}
    equations = [(known[x], known[x_dot]) for x, x_dot in zip(q, v, strict=True)]
    equations += [(known[x], translated(each, known)) for x, each in zip(v, accelerations, strict=True)]
    initial = [quadruple(x) for x in (*start, *velocity)]
    integrator = hy.taylor_adaptive(
        equations, initial, time=quadruple(times[0]), fp_type=Real, tol=Real("1e-33"), compact_mode=True
    )
    found = []
    for time in times:
        assert integrator.propagate_until(quadruple(time))[0] == hy.taylor_outcome.time_limit
        state = [mpmath.mpf(str(x)) for x in integrator.state]
        found.append([*state[: len(q)], *momenta(mpmath.mpf(time), *state)])
    return found


def main() -> None:
    mpmath.mp.dps = 45
    records = {}
    for name, motion in MOTIONS.items():
        system = lagrange("motion", motion.coordinates.split(), motion.lagrangian, forces=motion.forces)
        first, last = motion.span
        stepper = sc.compile_stepper(system, motion.method)
        run = stepper.integrate(motion.q, motion.p, t=first, t_end=last, tolerance=1e-12, check_growth=False)
        steps = run.t[np.linspace(0, len(run) - 1, STEPS).astype(int)]
        times = np.unique(np.concatenate([steps, np.linspace(first, last, EVEN)]))[:: 1 if last > first else -1]
        exact = states(motion, times, stepper.velocity(motion.q, motion.p, first))
        high = np.array([[float(x) for x in row] for row in exact])
        low = [[float(x - mpmath.mpf(y)) for x, y in zip(*rows, strict=True)] for rows in zip(exact, high, strict=True)]
        records |= {f"{name}/t": times, f"{name}/high": high, f"{name}/low": np.array(low, np.float32)}
        print(name, len(times), flush=True)
    np.savez_compressed(RECORDS, **records)


if __name__ == "__main__":
    main()
