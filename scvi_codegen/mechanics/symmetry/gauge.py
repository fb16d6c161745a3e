"""Gauge functions f(q, t): the change of a Lagrangian along a symmetry is the time derivative df/dt.

A function of (q, v, t) is a total derivative f_t + f_q . v if and only if it is affine in v and its Euler-Lagrange
expression is zero (Olver, *Applications of Lie Groups to Differential Equations*, 2nd ed. 1993, theorem 4.7); f is
then its integral along straight lines from q = 0.
"""

from __future__ import annotations

from collections.abc import Iterable

import sympy
from sympy import Expr, Symbol
from sympy.integrals.manualintegrate import manualintegrate

from scvi_codegen.formulas.canonical import unsupported_part
from scvi_codegen.mechanics.symmetry.sampling import Sample
from scvi_codegen.mechanics.system import MechanicalSystem
from scvi_codegen.tables.precision import mp

NEGLIGIBLE = mp.mpf(10) ** -40


def integrated(system: MechanicalSystem, change: Expr) -> Expr | None:
    """Return a candidate for f, to be verified; ``None`` if SymPy does not find the integrals."""
    rest = dict.fromkeys(system.velocities, sympy.S.Zero)
    derivatives = [change.diff(v).xreplace(rest) for v in system.velocities]
    s = Symbol("s", positive=True)
    along = {q: s * q for q in system.coordinates}
    work = sympy.Add(
        *(q * derivative.xreplace(along) for q, derivative in zip(system.coordinates, derivatives, strict=True))
    )
    origin = change.xreplace(rest | dict.fromkeys(system.coordinates, sympy.S.Zero))
    signed = {x: sympy.Dummy(positive=True) for x in (*system.coordinates, *system.parameters)}
    parts = (_definite(work.xreplace(signed), s), manualintegrate(sympy.expand(origin), system.time))
    total = sympy.expand(sympy.Add(*parts)).xreplace({dummy: x for x, dummy in signed.items()})
    return None if unsupported_part(total) else total


def _definite(expression: Expr, s: Symbol) -> Expr:
    """Return the integral over s from 0 to 1."""
    primitive = manualintegrate(sympy.expand(expression), s)
    return primitive.subs(s, 1) - primitive.subs(s, 0)


def is_total_derivative(system: MechanicalSystem, change: Expr, points: Iterable[Sample]) -> bool | None:
    """Return whether such an f exists, tested in 60 digits at these points; ``None`` if there is no point."""
    q, v, t = system.coordinates, system.velocities, system.time
    derivatives = [change.diff(velocity) for velocity in v]
    conditions = [derivative.diff(velocity) for derivative in derivatives for velocity in v]
    for derivative, position in zip(derivatives, q, strict=True):
        moved = (derivative.diff(x) * rate for x, rate in zip((*q, t), (*v, sympy.S.One), strict=True))
        conditions.append(sympy.Add(*moved, -change.diff(position)))
    decided = None
    for sample in points:
        decided = True
        for condition in conditions:
            terms = [sample.value(term) for term in sympy.Add.make_args(condition)]
            if abs(mp.fsum(terms)) > NEGLIGIBLE * (1 + mp.fsum(map(abs, terms))):
                return False
    return decided
